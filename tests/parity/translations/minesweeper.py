"""MineSweeper: all fields are shared."""

from typing import Any

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.minesweeper.rules import COVERED_MINE, SWEPT, MineSweeperState
from tests.parity.translation import Array, Translation, number, small


def to_ours(game: Any, theirs: Any) -> MineSweeperState:
    """Field by field."""
    return MineSweeperState(
        number(theirs.action_x),
        number(theirs.action_y),
        small(theirs.mine_grid),
        small(theirs.neighbor_grid),
        number(theirs.score),
        number(theirs.viewed_count),
        number(theirs.timestep),
    )


def to_theirs(game: Any, ours: MineSweeperState) -> dict[str, Any]:
    """Field by field."""
    return {
        "action_x": ours.x,
        "action_y": ours.y,
        "timestep": ours.timestep,
        "score": ours.score,
        "mine_grid": ours.grid,
        "neighbor_grid": ours.neighbours,
        "viewed_count": ours.repeats,
    }


def hasten(key: Array, game: Any, ours: MineSweeperState) -> MineSweeperState:
    """Most safe cells swept, at least one left, and few repeats to go."""
    for_cells, for_repeats = jax.random.split(key)
    mine = ours.grid == COVERED_MINE
    last = jnp.argmin(mine) == jnp.arange(game.level.cells).reshape(mine.shape)
    swept = jax.random.bernoulli(for_cells, 0.8, mine.shape) & ~mine & ~last
    repeats = game.level.max_repeats - jax.random.randint(for_repeats, (), 0, 4)
    grid = jnp.where(swept, jnp.int8(SWEPT), ours.grid)
    return ours._replace(grid=grid, score=swept.sum(dtype=jnp.int32), repeats=repeats)


TRANSLATION = Translation(to_ours, to_theirs, "timestep", hasten=hasten)
