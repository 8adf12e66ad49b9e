"""Arguments that measures share, checked before anything is played: one line names what is wrong
(ValueError).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn

from arcade_torch.agents.checked import coerce, require, whole_from
from arcade_torch.envs_jax.validation import kind_of

__all__ = [
    "check_by_name",
    "check_flags",
    "check_played",
    "check_strengths",
    "check_twin",
    "check_white",
    "check_whole",
    "no_policy",
]


def check_played(seed: Any, observability: Any = None, **counts: tuple[Any, int]) -> None:
    """Refuse a seed that is no whole number from 0, an unknown twin, and counts, by name, that are
    no whole numbers from their least value on.
    """
    for name, (value, least) in counts.items():
        whole_from(least, name, value)
    whole_from(0, "seed", seed)
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
    allowed = "numbers of at least 0"
    for value in _several(name, values, allowed):
        require(_is_finite_from_0(value), name, list(values), allowed)


def check_whole(name: str, values: Any) -> None:
    """Refuse what are not whole numbers from 0, one at least; 2.0 is one."""
    allowed = "whole numbers of at least 0"
    for value in _several(name, values, allowed):
        is_whole = _is_finite_from_0(value) and float(value) == int(value)
        require(is_whole, name, list(values), allowed)


def _several(name: str, values: Any, allowed: str) -> Any:
    """The values of a list or an array that has some; anything else is refused."""
    is_list = isinstance(values, Sequence) or hasattr(values, "tolist")
    require(is_list and not isinstance(values, str) and len(values) > 0, name, values, allowed)
    return values


def _is_finite_from_0(value: Any) -> bool:
    is_number = hasattr(value, "__float__") and not isinstance(value, bool)
    return is_number and 0 <= float(value) < math.inf


def check_by_name(argument: str, results: Any) -> None:
    """Refuse what is no dictionary of results (TypeError), and an empty one."""
    if not isinstance(results, Mapping):
        raise TypeError(
            f"{argument} must be a dictionary of results by name; got {kind_of(results)}"
        )
    require(len(results) > 0, argument, dict(results), "of one policy at least")


def no_policy(model: Any) -> str:
    """What is said to somebody whose model is no policy."""
    forms = (
        "an agent, a TensorDict policy, a network with encode and remember, a Policy or a pair "
        "(encode, remember)"
    )
    advice = ""
    if isinstance(model, nn.Module):
        name = type(model).__name__
        advice = f': TensorDictModule({name}, ["pixels"], ["action_value"]) makes a policy of it'
        advice += "; docs/measures/your-own.md says how with a recurrent state"
    return f"model must be {forms}, got {type(model).__name__}{advice}"
