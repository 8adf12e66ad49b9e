"""Fields of plain numbers and words that are checked: one clear line says what arrived and what is
allowed. Nothing here imports torch.
"""

import dataclasses
import json
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    get_args,
    get_origin,
    get_type_hints,
)

from arcade_torch.envs_jax.validation import format_value


class Range(NamedTuple):
    """Values that a field may hold: in words, and as a test."""

    allowed: str
    holds: Callable[[Any], bool]


Text = Annotated[str, Range("a non-empty string", lambda x: x != "")]
# Bounded, so that no slip and no file of somebody else asks for all memory there is.
Count = Annotated[int, Range("a whole number >= 1 (and at most 10**6)", lambda x: 1 <= x <= 10**6)]
CountOrZero = Annotated[int, Range("a whole number >= 0", lambda x: 0 <= x <= 10**15)]
Positive = Annotated[float, Range("a number > 0", lambda x: x > 0.0)]
PositiveOrZero = Annotated[float, Range("a number >= 0", lambda x: x >= 0.0)]
Finite = Annotated[float, Range("a finite number", math.isfinite)]
Fraction = Annotated[float, Range("a number in [0, 1]", lambda x: 0.0 <= x <= 1.0)]
Options = Mapping[str, Any]


def require(condition: bool, name: str, value: Any, allowed: str) -> None:
    """Unless a condition holds, refuse a value (ValueError) in one line that names it and says what
    is allowed.
    """
    if not condition:
        raise ValueError(f"{name} must be {allowed}; got {format_value(value)}")


def whole_from(least: int, name: str, value: Any) -> int:
    """A whole number as an int, of numpy too; refuse anything else, and one below the least
    (ValueError).
    """
    allowed = f"a whole number, and at least {least}"
    require(not isinstance(value, bool), name, value, allowed)
    try:
        number = operator.index(value)
    except TypeError as error:
        raise ValueError(f"{name} must be {allowed}; got {format_value(value)}") from error
    require(number >= least, name, value, f"at least {least}")
    return number


def coerce(name: str, value: Any, kind: Any) -> Any:
    """The value of a field, whole floats as ints; refused where its annotation, type or
    :class:`Range`, forbids it.
    """
    if get_origin(kind) is Annotated:
        kind, limits = get_args(kind)
        value = coerce(name, value, kind)
        require(bool(limits.holds(value)), name, value, limits.allowed)
        return value
    if get_origin(kind) is Literal:
        return _choice(name, value, get_args(kind))
    if kind == Options:
        return _options(name, value)
    if kind is int:
        require(_is_number(value) and value == value // 1, name, value, "a whole number")
        return int(value)
    if kind is float:
        too_large = _is_number(value) and abs(value) >= 2.0**1000  # float() would overflow
        require(_is_number(value) and not too_large, name, value, "a number")
        return float(value)
    words = {str: "a string", bool: "true or false"}
    require(isinstance(value, kind), name, value, words.get(kind, f"a {kind.__name__}"))
    return value


def _choice(name: str, value: Any, choices: tuple[str, ...]) -> str:
    """One of several words."""
    *first, last = map(repr, choices)
    allowed = f"{', '.join(first)} or {last}" if first else last
    require(isinstance(value, str) and value in choices, name, value, allowed)
    return value  # type: ignore[no-any-return]


def _options(name: str, value: Any) -> dict[str, Any]:
    """A table of options that a config file can hold."""
    require(isinstance(value, Mapping), name, value, "a mapping of option names to values")
    for option, given in value.items():
        kept = survives_json({option: given})
        require(kept, f"{name}.{option}", given, "a value that JSON gives back as it was")
    return dict(value)


def _is_number(value: Any) -> bool:
    """Whether a value is a number, true and false not counted."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def survives_json(value: Any) -> bool:
    """Whether JSON gives a value back as it was."""
    try:
        return bool(json.loads(json.dumps(value)) == value)
    except (TypeError, ValueError, RecursionError):  # it cannot be written, or not be compared
        return False


@dataclass(frozen=True)
class Checked:
    """A frozen dataclass whose fields are checked by their annotations, with one clear line for
    what does not fit.
    """

    # what the names of its fields begin with in messages
    GROUP: ClassVar[str] = ""

    def __post_init__(self) -> None:
        kinds = get_type_hints(type(self), include_extras=True)
        for item in dataclasses.fields(self):
            value = coerce(self.GROUP + item.name, getattr(self, item.name), kinds[item.name])
            object.__setattr__(self, item.name, value)

    def _require(self, condition: bool, name: str, allowed: str) -> None:
        require(condition, self.GROUP + name, getattr(self, name, None), allowed)
