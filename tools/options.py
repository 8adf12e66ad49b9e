"""Options of a command, read into its dataclass by tyro; whole numbers, and NAME=VALUE."""

import json
import re
from collections.abc import Sequence
from contextlib import redirect_stderr
from io import StringIO
from typing import Any

from arcade_torch.tools.optional import need

_FRAME = re.compile(r"\x1b\[[0-9;]*m|^ *[│╭╰|+] ?| ?[│╮╯|+] *$", re.MULTILINE)
_RULE = re.compile(r"^ *[─-](?: |[─-]{3}).*$", re.MULTILINE)
_TITLES = ("Unrecognized options", "Value error", "Required options", "Invalid choice", "Parsing error")


def parse(kind: Any, words: Sequence[str], prog: str, default: Any = None) -> Any:
    """Read options into a dataclass.

    Args:
        kind: the dataclass.
        words: the options.
        prog: the command, for messages.
        default: instance whose values stand where no option is given.

    Raises:
        ValueError: an option is unknown, missing or malformed; one line.
        SystemExit: help was asked for.
    """
    tyro = need("tyro")
    captured, extra = StringIO(), {} if default is None else {"default": default}
    try:
        with redirect_stderr(captured):
            config = (tyro.conf.FlagCreatePairsOff,)
            return tyro.cli(kind, args=list(words), prog=prog, config=config, registry=_registry(), **extra)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ValueError(flatten_parser_message(captured.getvalue(), prog)) from None


def flatten_parser_message(text: str, prog: str) -> str:
    """Turn the framed message that the option parser wrote to stderr into one line."""
    parts = [" ".join(part.split()) for part in _RULE.split(_FRAME.sub("", text))]
    said = [part for part in parts if part and part not in _TITLES] or ["the options could not be read"]
    near = [part.split()[3] for part in said if part.startswith("Perhaps you meant: ")]
    return said[0].rstrip(".") + "".join(f"; perhaps you meant {name}" for name in near) + f" (see {prog} --help)"


def _registry() -> Any:
    """Lets options that count take 2e7 and 40_000."""
    constructors = need("tyro.constructors")
    registry = constructors.ConstructorRegistry()

    @registry.primitive_rule  # type: ignore[untyped-decorator]
    def whole(info: Any) -> Any:
        spec = constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="INT",
            instance_from_str=lambda parts: whole_number(parts[0]),
            is_instance=lambda value: type(value) is int,
            str_from_instance=lambda value: [str(value)],
        )
        return spec if info.type is int else None

    return registry


def whole_number(text: str) -> int:
    """A whole number, also as 2e7 or 40_000.

    Example:
        >>> whole_number("2e7"), whole_number("40_000")
        (20000000, 40000)
    """
    if re.fullmatch(r"\d{1,15}(\.\d{0,15})?[eE]\+?\d{1,2}", text) and float(text).is_integer():
        return int(float(text))
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{text!r} is no whole number") from None


def name_and_value(text: str) -> tuple[str, Any]:
    """Read ``NAME=VALUE``; the value as JSON where it is JSON, otherwise as a word.

    Example:
        >>> name_and_value("tail=previous"), name_and_value("random_start=True")
        (('tail', 'previous'), ('random_start', True))
    """
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ValueError(f"an option is written NAME=VALUE, got {text!r}")
    try:
        return name, json.loads(value.lower() if value in ("True", "False") else value)
    except (ValueError, RecursionError):  # no JSON, or numbers and nesting that Python does not read
        return name, value
