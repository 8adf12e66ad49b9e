"""Arguments that measures share, checked before anything is played: one line names what is wrong
(ValueError).
"""

import math
from collections.abc import Sequence
from typing import Any

from arcade_torch.agents.checked import coerce, require, whole_number

__all__ = [
    "check_flags",
    "check_played",
    "check_strengths",
    "check_twin",
    "check_white",
    "check_whole",
]


def check_played(seed: Any, observability: Any = None, **counts: tuple[Any, int]) -> None:
    """Refuse a seed that is no whole number from 0, an unknown twin, and counts, by name, that are
    no whole numbers from their least value on.
    """
    for name, (value, least) in counts.items():
        whole_number(name, value, least)
    whole_number("seed", seed, 0)
    check_twin(observability)


def check_twin(observability: Any) -> None:
    """Refuse what names no twin; None leaves that to the agent."""
    is_twin = isinstance(observability, str | None) and observability in (None, "full", "partial")
    require(is_twin, "observability", observability, "'full' or 'partial'")


def check_white(white: Any) -> None:
    """Refuse what is not the value of a white pixel; None is that of the frames' type."""
    is_number = hasattr(white, "__float__") and not isinstance(white, bool)
    fits = white is None or (is_number and 0 < float(white) < math.inf)
    require(fits, "white", white, "a number above 0")


def check_flags(**flags: Any) -> None:
    """Refuse, by name, what is neither true nor false."""
    for name, value in flags.items():
        coerce(name, value, bool)


def check_strengths(name: str, values: Any) -> None:
    """Refuse what are not finite numbers from 0, one at least."""
    fits = isinstance(values, Sequence) or hasattr(values, "tolist")
    allowed = "numbers of at least 0"
    require(fits and not isinstance(values, str) and len(values) > 0, name, values, allowed)
    for value in values:
        is_number = hasattr(value, "__float__") and not isinstance(value, bool)
        require(is_number and 0 <= float(value) < math.inf, name, list(values), allowed)


def check_whole(name: str, values: Any) -> None:
    """Refuse what are not whole numbers from 0, one at least; 2.0 is one."""
    allowed = "whole numbers of at least 0"
    fits = isinstance(values, Sequence) or hasattr(values, "tolist")
    require(fits and not isinstance(values, str) and len(values) > 0, name, values, allowed)
    for value in values:
        is_number = hasattr(value, "__float__") and not isinstance(value, bool)
        is_whole = is_number and 0 <= float(value) < math.inf and float(value) == int(value)
        require(is_whole, name, list(values), allowed)
