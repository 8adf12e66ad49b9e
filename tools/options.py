"""Options of a command, read into its dataclass by tyro."""

import re
from collections.abc import Sequence
from contextlib import redirect_stderr
from io import StringIO
from typing import Any

from arcade_torch.tools.optional import need

_RULE = re.compile(r"[\u2500-]{4,}")
_FRAME = re.compile(r"^[\u2502\u256d\u2570|+]\s?|\s?[\u2502\u256e\u256f|+]$")
_TITLE = re.compile(r"Unrecognized options|Value error|Required options|Invalid choice|Parsing error")


def flatten_parser_message(text: str, prog: str) -> str:
    """Turn the framed message of the option parser into one line.

    Args:
        text: what the parser wrote to stderr.
        prog: the command, for example ``arcade-torch train``.
    """
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    sections: list[list[str]] = [[]]
    for raw in text.splitlines():
        line = _FRAME.sub("", raw.strip()).strip()
        if _RULE.fullmatch(line):
            sections.append([])
        elif line and line[:2] not in ("\u2500 ", "- "):  # the frame's title repeats what follows
            sections[-1].append(line)
    sections = [part for part in sections if part]
    if sections and len(sections[0]) == 1 and len(sections) > 1 and _TITLE.fullmatch(sections[0][0]):
        sections = sections[1:]  # a title without a frame
    head = " ".join(sections[0]) if sections else "the options could not be read"
    near = [part for part in sections[1:] if part[0].startswith("Perhaps you meant")]
    if near and len(near[0]) > 1:
        head += f"; perhaps you meant {near[0][1]}"
    return f"{head.rstrip('.')} (see {prog} --help)"


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
    captured = StringIO()
    try:
        with redirect_stderr(captured):
            extra = {} if default is None else {"default": default}
            config = (tyro.conf.FlagCreatePairsOff,)
            return tyro.cli(kind, args=list(words), prog=prog, config=config, registry=_registry(), **extra)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ValueError(flatten_parser_message(captured.getvalue(), prog)) from None


def _registry() -> Any:
    """Lets options that count take 2e7 and 40_000."""
    constructors = need("tyro.constructors")
    registry = constructors.ConstructorRegistry()

    @registry.primitive_rule  # type: ignore[untyped-decorator]
    def whole(info: Any) -> Any:
        if info.type is not int:
            return None
        return constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="INT",
            instance_from_str=lambda parts: whole_number(parts[0]),
            is_instance=lambda value: type(value) is int,
            str_from_instance=lambda value: [str(value)],
        )

    return registry


def whole_number(text: str) -> int:
    """A whole number, also as 2e7 or 40_000.

    Raises:
        ValueError: the text is none.

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
