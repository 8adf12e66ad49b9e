"""The rules of BattleShip: a cursor fires at cells of a sea that hides ships; boards are indexed
[x, y].
"""

from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.boards import cell_mask, move_cursor
from arcade_torch.envs_jax.game import FIRE, UNSET, Array, Rules

SHIPS = (2, 3, 3, 4)  # lengths, in the order of placement
SHIP_CELLS = sum(SHIPS)  # hitting one pays 1 / SHIP_CELLS


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    side: int  # cells per side of the sea

    @property
    def cells(self) -> int:
        """Cells of the sea."""
        return self.side**2

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return 2 * self.cells

    @property
    def max_repeats(self) -> int:
        """Shots at cells shot at before that end the game; each pays ``-2 / cells``."""
        return self.cells // 2


LEVELS = {"BattleShipEasy": Params(8), "BattleShipMedium": Params(10), "BattleShipHard": Params(12)}


class BattleShipState(NamedTuple):
    """A sea, what has been shot at, a cursor, and three counters."""

    x: Array  # int32, column of the cursor
    y: Array  # int32, row of the cursor
    board: Array  # int8 [side, side], 1 where a ship lies
    guesses: Array  # int8 [side, side], 1 where a shot fell
    hits: Array  # int32, ship cells hit; the number on the screen
    repeats: Array  # int32, shots at cells shot at before
    timestep: Array  # int32, steps taken
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def free_places(occupied: Array, length: int) -> Array:
    """Where a ship of ``length`` cells fits: bool [2, side, side], its first cell if it lies along
    x, then along y.

    ``occupied``, bool [side, side], are cells that are taken; touching them is allowed.
    """
    side = occupied.shape[0]
    padded = jnp.pad(occupied, (0, length - 1), constant_values=True)
    along_x = reduce(or_, (padded[k : k + side, :side] for k in range(length)))
    along_y = reduce(or_, (padded[:side, k : k + side] for k in range(length)))
    return ~jnp.stack([along_x, along_y])


def place_ship(draw: Array, occupied: Array, length: int) -> Array:
    """Put a ship at one of the places where it fits, ``free_places``: bool [side, side], its cells.

    ``draw``, uint32, is which of the places, counted round: a uniform draw picks each with equal
    chance (the remainder favours some by less than one in ten million).
    """
    side = occupied.shape[0]
    places = free_places(occupied, length).reshape(2 * side, side)
    in_line = places.sum(1)
    line = jnp.arange(2 * side)
    cell = jnp.arange(side)
    # First the line that holds the chosen place, then the place in it: far cheaper than ranking all
    # places.
    before = jnp.sum(jnp.where(line < line[:, None], in_line, 0), 1)
    rest = (draw % in_line.sum().astype(jnp.uint32)).astype(jnp.int32) - before
    chosen = (rest >= 0) & (rest < in_line)
    open_cells = (places & chosen[:, None]).any(0)
    rank = jnp.sum((cell < cell[:, None]) & open_cells, 1)
    y = jnp.sum(jnp.where(open_cells & (rank == jnp.sum(jnp.where(chosen, rest, 0))), cell, 0))
    first = jnp.sum(jnp.where(chosen, line, 0))
    x = first % side
    lies_along_y = first >= side
    columns = cell[:, None] - x
    rows = cell - y
    end_x = jnp.where(lies_along_y, 1, length)
    end_y = jnp.where(lies_along_y, length, 1)
    return (columns >= 0) & (columns < end_x) & (rows >= 0) & (rows < end_y)


def draw_board(key: Array, level: Params) -> Array:
    """Ships one after the other, each uniform over the places left to it: int8 [side, side]."""
    draws = jax.random.bits(key, (len(SHIPS),))
    occupied = jnp.zeros((level.side, level.side), bool)
    for draw, length in zip(draws, SHIPS, strict=True):
        occupied |= place_ship(draw, occupied, length)
    return occupied.astype(jnp.int8)


def reset(key: Array, level: Params, rules: Rules) -> BattleShipState:
    """Ships anywhere without overlap, the cursor on any cell, nothing shot at.

    With ``rules="reference"`` the cursor never begins in the last column or row.
    """
    for_ships, for_cursor = jax.random.split(key)
    span = level.side if rules == "default" else level.side - 1
    x, y = jax.random.randint(for_cursor, (2,), 0, span, dtype=jnp.int32)
    board = draw_board(for_ships, level)
    zero = jnp.int32(0)
    return BattleShipState(x, y, board, jnp.zeros_like(board), zero, zero, zero)


def step(
    state: BattleShipState, action: Array, level: Params, rules: Rules
) -> tuple[BattleShipState, Array, Array, Array]:
    """Move the cursor, or fire at the cell under it.

    By default the game ends when all ship cells are hit or the repeats reach their limit, and is
    cut at the time limit. With ``rules="reference"`` a shot judges the repeats before it, one shot
    late, and a move never looks at them.
    """
    x, y = move_cursor(state.x, state.y, action, level.side)

    fire = action == FIRE
    at_cursor = cell_mask(state.x, state.y, level.side)
    shot_before = jnp.any(at_cursor & (state.guesses == 1))
    hit = fire & ~shot_before & jnp.any(at_cursor & (state.board == 1))
    again = fire & shot_before

    guesses = jnp.where(at_cursor & fire, jnp.int8(1), state.guesses)
    hits = state.hits + hit
    repeats = state.repeats + again
    new = BattleShipState(x, y, state.board, guesses, hits, repeats, state.timestep + 1)
    reward = jnp.where(hit, 1.0 / SHIP_CELLS, jnp.where(again, -2.0 / level.cells, 0.0))
    repeat_limit = new.repeats >= level.max_repeats
    if rules == "reference":
        repeat_limit = fire & (state.repeats >= level.max_repeats)
    won = new.hits >= SHIP_CELLS
    return new, reward.astype(jnp.float32), won | repeat_limit, new.timestep >= level.max_steps
