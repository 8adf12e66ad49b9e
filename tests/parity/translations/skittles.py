"""Skittles: the published grid has one block a row; the new row is drawn by the published step and
adopted by ours.
"""

from typing import Any

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.skittles.rules import CELLS, MAX_STEPS, NO_BLOCK, SkittlesState
from tests.parity.translation import Array, Translation, number


def to_ours(game: Any, theirs: Any) -> SkittlesState:
    """Blocks by their column; what the reference rules do not use, the survivors' columns and the
    flicker, is blank.
    """
    grid = jnp.asarray(theirs.matrix_state)
    column = jnp.where(grid.any(1), jnp.argmax(grid, 1), NO_BLOCK)
    return SkittlesState(
        number(column),
        number(theirs.color_indexes),
        number(theirs.x),
        jnp.ones(game.level.width, bool),
        jnp.zeros(2, jnp.uint32),
        number(theirs.time),
    )


def to_theirs(game: Any, ours: SkittlesState) -> dict[str, Any]:
    """Nobody is hit in mid-episode; the score is the time."""
    return {
        "matrix_state": ours.column[:, None] == jnp.arange(CELLS),
        "color_indexes": ours.colour,
        "x": ours.x,
        "xp": 0,
        "over": 0,
        "time": ours.time,
        "score": ours.time,
    }


def adopt(game: Any, ours: SkittlesState, theirs: Any) -> SkittlesState:
    """The new block falls where the published step drew it."""
    drawn = to_ours(game, theirs)
    column = ours.column.at[0].set(drawn.column[0])
    return ours._replace(column=column, safe=drawn.safe, flicker_key=drawn.flicker_key)


def reported(
    game: Any, ours: SkittlesState, terminated: Array, truncated: Array
) -> tuple[Array, Array]:
    """S9: ``terminated`` counts the blocks that hit; here whether any did is compared."""
    return terminated, truncated


def hasten(key: Array, game: Any, ours: SkittlesState) -> SkittlesState:
    """A block in every row, somewhere in the middle of the episode."""
    for_blocks, for_time = jax.random.split(key)
    column = game.level.first + jax.random.randint(for_blocks, (CELLS,), 0, game.level.width)
    time = jax.random.randint(for_time, (), CELLS, MAX_STEPS)
    # A block in the last row would have hit an agent that stands there.
    return ours._replace(
        column=column, time=time, x=game.level.first + (column[-1] - game.level.first + 1) % 6
    )


TRANSLATION = Translation(to_ours, to_theirs, "time", adopt=adopt, reported=reported, hasten=hasten)
