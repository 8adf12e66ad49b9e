"""The rules of MineSweeper: a cursor sweeps cells one by one; boards are indexed [x, y]."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.boards import cell_mask, move_cursor
from arcade_torch.envs_jax.cards import random_ranks
from arcade_torch.envs_jax.game import FIRE, UNSET, Array, Rules


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    side: int  # cells per side of the board
    mines: int  # mines on the board

    @property
    def cells(self) -> int:
        """Cells of the board."""
        return self.side**2

    @property
    def safe(self) -> int:
        """Cells without a mine; sweeping one pays ``1 / safe``."""
        return self.cells - self.mines

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return 2 * self.cells

    @property
    def max_repeats(self) -> int:
        """Sweeps of swept cells that end the game; each pays ``-2 / cells``."""
        return self.cells // 2


LEVELS = {
    "MineSweeperEasy": Params(4, 2),
    "MineSweeperMedium": Params(6, 6),
    "MineSweeperHard": Params(8, 10),
}

COVERED_SAFE = 0
COVERED_MINE = 1
SWEPT = 2


class MineSweeperState(NamedTuple):
    """A board, a cursor, and three counters."""

    x: Array  # int32, column of the cursor
    y: Array  # int32, row of the cursor
    grid: Array  # int8 [side, side], COVERED_SAFE, COVERED_MINE or SWEPT
    # int8 [side, side], mines in the 3 x 3 block around each cell, itself included
    neighbours: Array
    score: Array  # int32, safe cells swept
    repeats: Array  # int32, sweeps of swept cells
    timestep: Array  # int32, steps taken
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def count_neighbours(mines: Array) -> Array:
    """Mines in the 3 x 3 block around each cell (int8 [side, side]); cells beyond the border count
    0.
    """
    padded = jnp.pad(mines, 1)
    side = mines.shape[0]
    columns = padded[:side] + padded[1 : side + 1] + padded[2:]
    return columns[:, :side] + columns[:, 1 : side + 1] + columns[:, 2:]


def mines(state: MineSweeperState, level: Params) -> Array:
    """Where mines lie, and lay: bool [side, side]. One that was hit is under the cursor."""
    covered = state.grid == COVERED_MINE
    hit = covered.sum() < level.mines
    return covered | (hit & cell_mask(state.x, state.y, level.side))


def draw_mines(key: Array, level: Params) -> Array:
    """Distinct uniformly random cells: int8 [side, side], 1 where a mine lies."""
    return (
        (random_ranks(key, level.cells) < level.mines)
        .astype(jnp.int8)
        .reshape(level.side, level.side)
    )


def reset(key: Array, level: Params, rules: Rules) -> MineSweeperState:
    """Mines on distinct uniformly random cells, the cursor on any cell.

    With ``rules="reference"`` the cursor never begins in the last column or row.
    """
    for_mines, for_cursor = jax.random.split(key)
    mines = draw_mines(for_mines, level)
    span = level.side if rules == "default" else level.side - 1
    x, y = jax.random.randint(for_cursor, (2,), 0, span, dtype=jnp.int32)
    zero = jnp.int32(0)
    return MineSweeperState(x, y, mines, count_neighbours(mines), zero, zero, zero)


def step(
    state: MineSweeperState, action: Array, level: Params, rules: Rules, mine_reward: float
) -> tuple[MineSweeperState, Array, Array, Array]:
    """Move the cursor, or sweep the cell under it.

    By default the game ends when a mine is hit, all safe cells are swept, or the repeats reach
    their limit, and is cut at the time limit. With ``rules="reference"`` a sweep judges repeats and
    time on the state before it, one sweep late, and a move never looks at the repeats.
    """
    x, y = move_cursor(state.x, state.y, action, level.side)

    fire = action == FIRE
    at_cursor = cell_mask(state.x, state.y, level.side)
    cell = jnp.sum(jnp.where(at_cursor, state.grid, 0))
    safe = fire & (cell == COVERED_SAFE)
    mine = fire & (cell == COVERED_MINE)
    again = fire & (cell == SWEPT)

    grid = jnp.where(at_cursor & fire, jnp.int8(SWEPT), state.grid)
    score = state.score + safe
    repeats = state.repeats + again
    new = MineSweeperState(x, y, grid, state.neighbours, score, repeats, state.timestep + 1)
    reward = jnp.where(
        safe,
        1.0 / level.safe,
        jnp.where(mine, mine_reward, jnp.where(again, -2.0 / level.cells, 0.0)),
    )
    cleared = new.score >= level.safe
    if rules == "default":
        repeat_limit = new.repeats >= level.max_repeats
        time_limit = new.timestep >= level.max_steps
    else:
        repeat_limit = fire & (state.repeats >= level.max_repeats)
        time_limit = jnp.where(fire, state.timestep, new.timestep) >= level.max_steps
    return new, reward.astype(jnp.float32), mine | cleared | repeat_limit, time_limit
