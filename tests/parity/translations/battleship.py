"""BattleShip: all fields are shared; the published state counts the hits twice."""

from typing import Any

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.battleship.rules import BattleShipState
from tests.parity.translation import Array, Translation, number, small


def to_ours(game: Any, theirs: Any) -> BattleShipState:
    """Field by field."""
    return BattleShipState(
        number(theirs.action_x),
        number(theirs.action_y),
        small(theirs.board),
        small(theirs.guesses),
        number(theirs.hits),
        number(theirs.repeat_count),
        number(theirs.timestep),
    )


def to_theirs(game: Any, ours: BattleShipState) -> dict[str, Any]:
    """Field by field."""
    return {
        "action_x": ours.x,
        "action_y": ours.y,
        "board": ours.board,
        "guesses": ours.guesses,
        "hits": ours.hits,
        "score": ours.hits,
        "repeat_count": ours.repeats,
        "timestep": ours.timestep,
    }


def hasten(key: Array, game: Any, ours: BattleShipState) -> BattleShipState:
    """Nearly all cells shot at, at least one ship cell left, and few repeats to go."""
    for_shots, for_repeats = jax.random.split(key)
    last = jnp.argmax(ours.board) == jnp.arange(game.level.cells).reshape(ours.board.shape)
    guesses = jax.random.bernoulli(for_shots, 0.9, ours.board.shape) & ~last
    repeats = game.level.max_repeats - jax.random.randint(for_repeats, (), 0, 4)
    return ours._replace(
        guesses=small(guesses), hits=(guesses * ours.board).sum(dtype=jnp.int32), repeats=repeats
    )


TRANSLATION = Translation(to_ours, to_theirs, "timestep", hasten=hasten)
