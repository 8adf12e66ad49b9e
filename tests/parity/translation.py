"""What a game has to say for its states to be compared: how they translate, and where random draws
come in.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

Array = jax.Array
State = Any


def same_flags(game: Any, state: State, terminated: Array, truncated: Array) -> tuple[Array, Array]:
    """The published game reports the flags that ours does."""
    return terminated, truncated


@dataclass(frozen=True)
class Translation:
    """How one game's states translate. All functions take single states; callers vectorise.

    Attributes:
        to_ours: ``(game, theirs)`` to our state.
        to_theirs: ``(game, ours)`` to a dict of all fields of the published state, for a state in
            mid-episode.
        clock: name of our field that counts steps.
        inject: ``(game, ours, theirs, their next)`` to ours: puts the outcome of a random draw of
            the published step where our step will find it.
        adopt: ``(game, our next, their next)`` to our next: replaces what our step drew by what the
            published one drew.
        reported: ``(game, our next, terminated, truncated)`` to the flags that the published game
            reports for that step, where they are not ours: an intended difference, named in the
            translation.
        hasten: ``(key, game, ours)`` to ours: leads a first state close to rare events.
        tolerance: absolute, on floating-point fields of the state.
        resync: after each comparison go on from the published state. For games that let rounding
            grow.
    """

    to_ours: Callable[[Any, State], State]
    to_theirs: Callable[[Any, State], dict[str, Any]]
    clock: str
    inject: Callable[[Any, State, State, State], State] = lambda game, ours, theirs, then: ours
    adopt: Callable[[Any, State, State], State] = lambda game, ours, then: ours
    reported: Callable[[Any, State, Array, Array], tuple[Array, Array]] = same_flags
    hasten: Callable[[Array, Any, State], State] = lambda key, game, ours: ours
    tolerance: float = 0.0
    resync: bool = False


def cast(like: State, fields: dict[str, Any]) -> State:
    """A published state with new values and the types of another one."""
    return like.replace(
        **{name: jnp.asarray(value, getattr(like, name).dtype) for name, value in fields.items()}
    )


def number(value: Any) -> Array:
    """A whole number as our states keep it: int32."""
    return jnp.asarray(value, jnp.int32)


def small(value: Any) -> Array:
    """A board or a pack as our states keep it: int8."""
    return jnp.asarray(value, jnp.int8)


def any_flag(game: Any, state: State, terminated: Array, truncated: Array) -> tuple[Array, Array]:
    """A published ``terminated`` that is up at a time limit as well (differences K3, T5)."""
    return terminated | truncated, truncated
