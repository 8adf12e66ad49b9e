"""What a refusal says: the value that arrived, on one line, and what is allowed."""

from typing import Any

_LONGEST = 200


def format_value(value: Any) -> str:
    """The ``repr`` of a value without line breaks, cut where it gets long.

    Example:
        >>> import numpy as np
        >>> format_value(np.zeros((2, 2)))
        'array([[0., 0.], [0., 0.]])'
    """
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}... ({len(text)} characters)"


def check_penalty(what: str, value: Any) -> None:
    """Raise TypeError unless the option ``what`` is an int or a float, and ValueError unless it is from -1 to 0."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{what} is {format_value(value)}, expected a number from -1 to 0")
    if not -1 <= value <= 0:
        raise ValueError(f"{what} is {value!r}, allowed: -1 to 0")


def check_choice(what: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Refuse a value outside a closed set.

    Args:
        what: Name of the option, for the message.
        value: What arrived.
        allowed: All values that are allowed.

    Raises:
        ValueError: ``value`` is not one of ``allowed``.
    """
    kinds = tuple({type(one) for one in allowed})
    if isinstance(value, bool) or not isinstance(value, kinds) or value not in allowed:
        raise ValueError(f"{what} is {format_value(value)}, allowed: {', '.join(map(repr, allowed))}")
