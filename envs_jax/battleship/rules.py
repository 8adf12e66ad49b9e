"""The rules of BattleShip: a cursor fires at cells of a sea that hides ships; boards are indexed
[x, y].
"""

from dataclasses import dataclass
from functools import reduce
from operator import add, or_
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


def free_lines(columns: list[Array], length: int) -> list[Array]:
    """Where a ship of ``length`` cells fits: the bits of its first cell, int32 a line.

    Args:
        columns: int32 a column of the sea, bit y is set where the cell is taken. Touching such
            cells is allowed.
        length: Cells of the ship.

    Returns:
        The columns for a ship along x, then those for one along y.
    """
    side = len(columns)
    sea = (1 << side) - 1
    along_x = []
    along_y = []
    for x, column in enumerate(columns):
        fits = x + length <= side
        taken = reduce(or_, columns[x : x + length])
        along_x.append(sea & ~taken if fits else jnp.int32(0))
        with_border = column | ~sea
        along_y.append(sea & ~reduce(or_, [with_border >> y for y in range(length)]))
    return along_x + along_y


def pick_line(draw: Array, lines: list[Array]) -> tuple[Array, Array, Array]:
    """Find the place of a number among the bits of lines, counted line by line.

    Args:
        draw: uint32, the number; counted round.
        lines: int32 each, some bits.

    Returns:
        The line that holds the place, its bits, and how many of them come before it; int32 each.
    """
    bits = jnp.stack(lines)
    number = jnp.arange(len(lines))
    in_line = jax.lax.population_count(bits)
    before = jnp.sum(jnp.where(number < number[:, None], in_line, 0), 1)
    rest = (draw % in_line.sum().astype(jnp.uint32)).astype(jnp.int32) - before
    chosen = (rest >= 0) & (rest < in_line)
    return (
        jnp.sum(jnp.where(chosen, number, 0)),
        jnp.sum(jnp.where(chosen, bits, 0)),
        jnp.sum(jnp.where(chosen, rest, 0)),
    )


def pick_line_in_turn(draw: Array, lines: list[Array]) -> tuple[Array, Array, Array]:
    """:func:`pick_line` without reductions: on a GPU each would be a kernel of its own."""
    in_line = [jax.lax.population_count(line) for line in lines]
    total = reduce(add, in_line)
    rest = (draw % total.astype(jnp.uint32)).astype(jnp.int32)
    chosen_line = jnp.int32(0)
    bits = jnp.int32(0)
    rank = jnp.int32(0)
    for number, line in enumerate(lines):
        chosen = (rest >= 0) & (rest < in_line[number])
        chosen_line |= jnp.where(chosen, number, 0)
        bits |= jnp.where(chosen, line, 0)
        rank |= jnp.where(chosen, rest, 0)
        rest -= in_line[number]
    return chosen_line, bits, rank


def place_ship(draw: Array, columns: list[Array], length: int) -> list[Array]:
    """Put a ship at one of the places where it fits, ``free_lines``: its cells as bits, int32 a
    column.

    ``draw``, uint32, is which of the places, counted round: a uniform draw picks each with equal
    chance (the remainder favours some by less than one in ten million).
    """
    side = len(columns)
    lines = free_lines(columns, length)
    # First the line that holds the chosen place, then the place in it: far cheaper than ranking all
    # places.
    line, bits, rank = jax.lax.platform_dependent(
        draw, lines, cuda=pick_line_in_turn, default=pick_line
    )
    for lower in range(side - 1):
        bits = jnp.where(lower < rank, bits & (bits - 1), bits)  # without the lowest
    first = bits & -bits
    ship = []
    for x in range(side):
        is_across = (line <= x) & (x < line + length)
        along = jnp.where(line == side + x, first * ((1 << length) - 1), 0)
        ship.append(jnp.where(is_across, first, along))
    return ship


def draw_board(key: Array, level: Params) -> Array:
    """Ships one after the other, each uniform over the places left to it: int8 [side, side]."""
    draws = jax.random.bits(key, (len(SHIPS),))
    columns = [jnp.int32(0)] * level.side
    for draw, length in zip(draws, SHIPS, strict=True):
        ship = place_ship(draw, columns, length)
        columns = [taken | cells for taken, cells in zip(columns, ship, strict=True)]
    bits = jnp.stack(columns)[:, None] >> jnp.arange(level.side)
    return (bits & 1).astype(jnp.int8)


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
