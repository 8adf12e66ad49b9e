"""What a refusal says: the value that arrived, on one line, and what is allowed."""

import os
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

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


def with_article(noun: str) -> str:
    """A noun with a or an, by its first letter; u is that of uint8.

    Example:
        >>> [with_article(noun) for noun in ("int", "uint8", "dict")]
        ['an int', 'a uint8', 'a dict']
    """
    return f"an {noun}" if noun[:1].lower() in "aeio" else f"a {noun}"


def kind_of(value: object) -> str:
    """The type of a value, as a message names it.

    Example:
        >>> kind_of(3), kind_of({})
        ('an int', 'a dict')
    """
    return with_article(type(value).__name__)


def plain(value: Any) -> Any:
    """A number or a bool of numpy, torch or JAX as one of Python; anything else as it is.

    Example:
        >>> import numpy as np
        >>> plain(np.int64(128)), plain(np.True_), plain("text")
        (128, True, 'text')
    """
    is_number = getattr(value, "ndim", None) == 0 and hasattr(value, "item")
    return value.item() if is_number else value


def check_penalty(option: str, value: Any) -> None:
    """Raise TypeError unless the ``option`` is an int or a float, and ValueError unless it is
    from -1 to 0.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{option} is {format_value(value)}, expected a number from -1 to 0")
    if not -1 <= value <= 0:
        raise ValueError(f"{option} is {value!r}, allowed: -1 to 0")


def check_choice(option: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Refuse a value outside a closed set.

    Args:
        option: Its name, for the message.
        value: What arrived.
        allowed: All values that are allowed.

    Raises:
        ValueError: ``value`` is not one of ``allowed``.
    """
    kinds = tuple({type(one) for one in allowed})
    if isinstance(value, bool) or not isinstance(value, kinds) or value not in allowed:
        raise ValueError(
            f"{option} is {format_value(value)}, allowed: {', '.join(map(repr, allowed))}"
        )


MOST_ENVS = 2**20
"""The largest batch: its frames are 52 GB at 128 pixels. More is a slip, and would end in a failed
allocation.
"""


def check_num_envs(num_envs: Any) -> int:
    """The number of envs as an int; raises unless it is a whole number from 1 to ``MOST_ENVS``."""
    num_envs = plain(num_envs)
    if isinstance(num_envs, bool) or not isinstance(num_envs, int):
        raise TypeError(f"num_envs is {format_value(num_envs)}, expected an int of 1 or more")
    if num_envs < 1:
        raise ValueError(f"num_envs is {num_envs}, expected 1 or more")
    if num_envs > MOST_ENVS:
        raise ValueError(f"num_envs is above {MOST_ENVS}, the most that a batch may hold")
    return num_envs


def check_fits(num_envs: int, obs_size: int) -> None:
    """Raise ValueError if the frames of one step need more memory than the machine has."""
    pages = os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else -1
    frames = num_envs * obs_size * obs_size * 3
    memory = pages * os.sysconf("SC_PAGE_SIZE") if pages > 0 else frames
    if frames > memory:
        raise ValueError(
            f"num_envs is {num_envs}: the frames of one step take {frames / 1e9:.0f} GB, "
            f"this machine has {memory / 1e9:.0f}: take at most {memory * num_envs // frames // 4}"
        )


Observability = Literal["full", "partial"] | npt.ArrayLike  # a tensor is array-like too
_ALLOWED = "allowed: 'full', 'partial', or bools, one an env (True = partial)"


def partial_flags(
    observability: Observability | None, num_envs: int, partial_obs: bool | None = None
) -> npt.NDArray[np.bool_]:
    """Which envs show the Markov state (MDP) and which the partial view (POMDP): one flag an env.

    Args:
        observability: ``"full"``, ``"partial"``, or bool [num_envs], array or tensor; None if not
            given.
        num_envs: Number of envs.
        partial_obs: The alias: true means ``"partial"``; None if not given.

    Returns:
        bool [num_envs], true where the env shows its POMDP twin. False everywhere if neither is
        given. A new array.

    Raises:
        ValueError: Both are given, or another word, type or shape.
        TypeError: ``partial_obs`` is no bool.
    """
    partial_obs = plain(partial_obs)
    if partial_obs is not None:
        if observability is not None:
            raise ValueError(
                "observability and partial_obs are given: keep observability, partial_obs is its "
                "alias"
            )
        if not isinstance(partial_obs, bool):
            raise TypeError(f"partial_obs is {format_value(partial_obs)}, allowed: True, False")
        return np.full(num_envs, partial_obs)
    if observability is None or isinstance(observability, str):
        if observability not in (None, "full", "partial"):
            raise ValueError(f"observability is {format_value(observability)}, {_ALLOWED}")
        return np.full(num_envs, observability == "partial")
    try:
        flags = np.array(
            observability.cpu().numpy() if hasattr(observability, "cpu") else observability
        )
    except ValueError:  # rows of different lengths
        flags = np.array(None)
    if flags.dtype != np.bool_ or flags.shape != (num_envs,):
        raise ValueError(
            f"observability is {flags.dtype} {flags.shape}, expected bool ({num_envs},): {_ALLOWED}"
        )
    return flags


def changed_flags(observability: Observability, num_envs: int) -> npt.NDArray[np.bool_]:
    """The flags of running envs whose twin is changed, as :func:`partial_flags` gives them; a
    ValueError for None too.
    """
    if observability is None:
        raise ValueError(f"observability is None, {_ALLOWED}")
    return partial_flags(observability, num_envs)
