"""Breakout: all fields are shared; the published bricks are a float board of all 20 rows."""

from typing import Any

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.breakout.rules import (
    BRICKS,
    COLUMNS,
    ROWS,
    WALL_ROWS,
    WALL_TOP,
    BreakoutState,
)
from tests.parity.translation import Array, Translation, any_flag, number


def to_ours(game: Any, theirs: Any) -> BreakoutState:
    """The rows of the wall alone."""
    numbers = (
        theirs.ball_x,
        theirs.ball_y,
        theirs.ball_dir,
        theirs.last_x,
        theirs.last_y,
        theirs.pos,
    )
    bricks = jnp.asarray(theirs.brick_map)[WALL_TOP : WALL_TOP + WALL_ROWS] > 0
    strike = jnp.asarray(theirs.strike, bool)
    return BreakoutState(
        *map(number, numbers), bricks, strike, number(theirs.score), number(theirs.time)
    )


def to_theirs(game: Any, ours: BreakoutState) -> dict[str, Any]:
    """``terminal`` is false in mid-episode."""
    below = ROWS - WALL_TOP - WALL_ROWS
    return {
        "ball_y": ours.ball_y,
        "ball_x": ours.ball_x,
        "ball_dir": ours.ball_dir,
        "pos": ours.pos,
        "brick_map": jnp.pad(ours.bricks, ((WALL_TOP, below), (0, 0))),
        "strike": ours.strike,
        "last_y": ours.last_y,
        "last_x": ours.last_x,
        "time": ours.time,
        "terminal": False,
        "score": ours.score,
    }


def hasten(key: Array, game: Any, ours: BreakoutState) -> BreakoutState:
    """A few bricks left."""
    for_many, for_one = jax.random.split(key)
    one = jax.random.randint(for_one, (), 0, BRICKS) == jnp.arange(BRICKS).reshape(
        WALL_ROWS, COLUMNS
    )
    bricks = one | jax.random.bernoulli(for_many, 0.1, one.shape)
    return ours._replace(bricks=bricks, score=BRICKS - bricks.sum(dtype=jnp.int32))


TRANSLATION = Translation(to_ours, to_theirs, "time", reported=any_flag, hasten=hasten)
