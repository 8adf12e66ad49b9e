"""Words of the command line: commands and their options, read into dataclasses by tyro."""

import json
import re
import shlex
from collections.abc import Sequence
from contextlib import redirect_stderr
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

from arcade_torch.tools.imports import FLAG, imported

LARGEST = 2**53
"""No option that counts something goes beyond; up to here every whole number is a float as well."""
SUGGESTION = "Perhaps you meant:"
"""What tyro writes in front of the nearest option."""


def parse(
    kind: Any, words: Sequence[str], prog: str, default: Any = None, description: str | None = None
) -> Any:
    """Read options of a command into a dataclass.

    Args:
        kind: the dataclass.
        words: the command line behind the command.
        prog: the command, as the help and messages name it.
        default: an instance, with the values where no option is given.
        description: what the help says of the command; by default the docstring of ``kind``.

    Raises:
        ValueError: an option is unknown, missing or malformed; says so in one line.
        SystemExit: the help was asked for, and is printed.
    """
    import tyro

    message = StringIO()
    try:
        with redirect_stderr(message):
            return tyro.cli(
                kind,
                args=list(words),
                prog=prog,
                description=description,
                default=tyro.MISSING_NONPROP if default is None else default,
                config=(tyro.conf.FlagCreatePairsOff,),
                registry=_whole_numbers(),
            )
    except SystemExit as stop:
        if not stop.code:  # the help was printed
            raise
    wrong = _in_one_line(message.getvalue())
    raise ValueError(f"{wrong}{_dashed_value(wrong, words)} (see {prog} --help)")


class Command:
    """What every command has; ``argv`` are the options that it was called with."""

    argv: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def parse(cls, words: Sequence[str], prog: str) -> Any:
        """Read the options; a ``ValueError`` says in one line what cannot be read."""
        return parse(cls, words, prog)

    def resume_hint(self) -> str:
        """What an interruption left, and how to go on."""
        return "no file is half written; the same command starts again"


def _whole_numbers() -> Any:
    """tyro's rules for types, and one of ours: options that count take 2e7 and 40_000."""
    from tyro import constructors

    registry = constructors.ConstructorRegistry()

    @registry.primitive_rule
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


def _dashed_value(wrong: str, words: Sequence[str]) -> str:
    """How to write a path that begins with a dash and is there, or a value that begins with one, if
    tyro missed it for that; else nothing.

    Example:
        >>> _dashed_value("Missing value for argument '--out'", ["--out", "-x.gif"])
        '; a value that begins with - is written --out=-x.gif'
    """
    for word in words:
        if re.match(r"-[^-]", word) and Path(word).exists():
            return f"; a path that begins with - is written ./{word}"
    missed = re.search(r"'(--[\w.-]+)'", wrong)
    if missed is None or "missing" not in wrong.lower():
        return ""
    for option, value in pairwise(words):
        if option == missed[1] and re.match(r"-[^-]", value):
            return f"; a value that begins with - is written {option}={value}"
    return ""


def _in_one_line(message: str) -> str:
    """What a message of tyro says is wrong, and the option that it suggests.

    tyro only prints: a title, then parts between rules, in a frame that depends on the terminal.
    The first part says what is wrong. Its error events are private, and version 1.0 has none.
    """
    from rich.text import Text

    text = Text.from_ansi(message).plain  # without colours
    parts = [""]
    options = list[str]()
    for framed in text.splitlines()[1:]:  # the first line is the title
        line = framed.strip("│╰╯ ")
        is_rule = line != "" and not line.strip("─-")
        if is_rule:
            parts.append("")
        else:
            parts[-1] = f"{parts[-1]} {line}".strip()
        if parts[-1].startswith(SUGGESTION) and line.startswith("--"):
            options.append(line.split()[0])
    parts = [part for part in parts if part]
    if not parts:
        return "the options could not be read"
    wrong = parts[0].rstrip(".")
    return f"{wrong}; perhaps you meant {_nearest_options(wrong, options)}" if options else wrong


def _nearest_options(wrong: str, options: Sequence[str]) -> str:
    """Of the options that tyro suggests all that differ from a word in their group alone, such as
    --ppo.num-envs and --pqn.num-envs, or else the first.
    """
    words = re.findall(r"--([\w-]+)", wrong)
    same = [option for option in options if option.rpartition(".")[2] in words]
    return " or ".join(same or options[:1])


def at_least(options: Any, **least: float) -> None:
    """Refuse options, fields of a dataclass, below a number, such as ``at_least(self, scale=1)``;
    of several, any.

    NaN is refused too, and what is above `LARGEST`.
    """
    for name, bound in least.items():
        value = getattr(options, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not numbers or not all(number >= bound for number in numbers):
            raise ValueError(f"--{name.replace('_', '-')} must be at least {bound}, got {value}")
    at_most(options, **dict.fromkeys(least, LARGEST))


def at_most(options: Any, **most: float) -> None:
    """Refuse options above a number, as `at_least` does those below one."""
    for name, bound in most.items():
        value = getattr(options, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(number <= bound for number in numbers):
            raise ValueError(f"--{name.replace('_', '-')} must be at most {bound:,}, got {value}")


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
    # no JSON, or numbers and nesting that Python does not read
    except (ValueError, RecursionError):
        return name, value


def command_line(words: Sequence[str]) -> str:
    """A line for a shell that runs ``arcade-torch`` with these words and the same imports."""
    return shlex.join(
        ["arcade-torch", *words, *(part for name in imported() for part in (FLAG, name))]
    )
