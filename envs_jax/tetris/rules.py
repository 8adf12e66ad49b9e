"""The rules of Tetris: one action, then gravity; a piece that cannot go further down locks at once.

Collisions are tested on rows of bits: bit ``MARGIN + c`` of a row is its column ``c``, and all bits
beyond the board are set, so that walls and floor are blocks like any other."""

from dataclasses import dataclass
from functools import reduce
from operator import and_, or_
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.cards import random_ranks
from arcade_torch.envs_jax.game import DOWN, LEFT, RIGHT, UNSET, UP, Array, Rules

ROWS = 20
COLUMNS = 10
# column and row of a new piece's box
SPAWN_X = 3
SPAWN_Y = 0
GOAL = 10  # lines that win
LINE_REWARD = 0.1  # for each of them
TOP_OUT_REWARD = -1.0
MAX_STEPS = 3000
MAX_AGE = 10  # the counter of steps since the spawn stops here
BOX = 4  # a piece lives in a box of 4 x 4 cells
ROTATIONS = 4

# Cells of each piece in its box, "12" for row 1 and column 2; one group for each rotation,
# clockwise.
_PIECES = {
    "I": "10 11 12 13 | 02 12 22 32 | 20 21 22 23 | 01 11 21 31",
    "O": "11 12 21 22 | 11 12 21 22 | 11 12 21 22 | 11 12 21 22",
    "T": "11 20 21 22 | 11 21 22 31 | 20 21 22 31 | 11 20 21 31",
    "S": "11 12 20 21 | 11 21 22 32 | 21 22 30 31 | 10 20 21 31",
    "Z": "10 11 21 22 | 12 21 22 31 | 20 21 31 32 | 11 20 21 30",
    "J": "10 20 21 22 | 11 12 21 31 | 20 21 22 32 | 11 21 30 31",
    "L": "12 20 21 22 | 11 21 31 32 | 20 21 22 30 | 10 11 21 31",
}
PIECES = len(_PIECES)


def _shapes() -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """The table above as bool [piece, rotation, row, column]."""
    shapes = np.zeros((PIECES, ROTATIONS, BOX, BOX), bool)
    for piece, rotations in enumerate(_PIECES.values()):
        for rotation, cells in enumerate(rotations.split("|")):
            for cell in cells.split():
                shapes[piece, rotation, int(cell[0]), int(cell[1])] = True
    return shapes


SHAPES = _shapes()


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    previews: int  # coming pieces that are shown
    fall: int  # cells a piece falls by itself at every step
    drop: int  # cells it goes down by a soft drop


LEVELS = {
    "TetrisEasy": Params(3, 1, 2),
    "TetrisMedium": Params(2, 1, 2),
    "TetrisHard": Params(1, 2, 3),
}

MARGIN = 3  # bits to the left of column 0: a box may stand so far out
_WIDTH = COLUMNS + 2 * MARGIN
_SOLID = (1 << _WIDTH) - 1  # a row under the floor
_WALLS = _SOLID & ~(((1 << COLUMNS) - 1) << MARGIN)
_DEPTH = 4  # the furthest row looked at: a fall of 3, and whether one more is free
_WINDOW = BOX + _DEPTH  # rows from the top of the box that a step can look at
_MASKS = (SHAPES.reshape(PIECES, ROTATIONS, -1) << np.arange(BOX * BOX)).sum(-1).astype(np.int32)


class TetrisState(NamedTuple):
    """The pile, the piece that falls, and the pieces that come."""

    board: Array  # int8 [20, 10], 0 empty, else piece + 1
    piece: Array  # int32, 0..6: I O T S Z J L
    px: Array  # int32, column of the left edge of its box, -2..8
    py: Array  # int32, row of the top edge of its box
    rot: Array  # int32, 0..3, clockwise
    next: Array  # int32 [P], the coming pieces that are shown, the nearest first
    bag: Array  # int32 [7], a permutation of the pieces
    bag_index: Array  # int32, which of it is dealt next
    lines: Array  # int32, rows removed; the score
    time: Array  # int32, steps taken
    just_locked: Array  # bool, the piece lies: the next step clears rows and brings the next piece
    frames_since_spawn: Array  # int32, 0..10
    terminal: Array  # bool, a new piece found no room
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def shuffled(key: Array) -> Array:
    """A random permutation of the seven pieces, int32 [7]."""
    return random_ranks(key, PIECES)


def deal_order(level: Params, rules: Rules) -> tuple[int, int]:
    """Which of the first bag is dealt first after the previews, and where a new bag begins.

    By default that is the next one, and the end of the bag. The reference begins further on, and
    counts seven pieces from there, so that with two or three previews some pieces of the first bag
    are left out and others come twice.
    """
    if rules == "default":
        return level.previews + 1, 0
    return 2 * level.previews, level.previews - 1


def reset(key: Array, level: Params, rules: Rules) -> TetrisState:
    """An empty board and a shuffled bag, whose first piece is at the top."""
    bag = shuffled(key)
    zero = jnp.int32(0)
    no = jnp.bool_(False)
    return TetrisState(
        board=jnp.zeros((ROWS, COLUMNS), jnp.int8),
        piece=bag[0],
        px=jnp.int32(SPAWN_X),
        py=jnp.int32(SPAWN_Y),
        rot=zero,
        next=bag[1 : 1 + level.previews],
        bag=bag,
        bag_index=jnp.int32(deal_order(level, rules)[0]),
        lines=zero,
        time=zero,
        just_locked=no,
        frames_since_spawn=zero,
        terminal=no,
    )


def complete_rows(board: Array) -> Array:
    """Which rows have no gap: bool [20]."""
    return (board > 0).all(1)


def covers(state: TetrisState) -> Array:
    """The cells of the board that the piece covers: bool [20, 10]."""
    row = jnp.arange(ROWS)[:, None] - state.py
    column = jnp.arange(COLUMNS) - state.px
    in_box = (row >= 0) & (row < BOX) & (column >= 0) & (column < BOX)
    bit = jnp.where(in_box, BOX * row + column, 0)
    return in_box & ((jnp.asarray(_MASKS)[state.piece, state.rot] >> bit) & 1 == 1)


def rows_of_bits(board: Array) -> Array:
    """The board with walls, and floor below: int32 [20 + 8]."""
    cells = jnp.where(board > 0, jnp.int32(1) << (MARGIN + jnp.arange(COLUMNS)), 0)
    return jnp.pad(cells.sum(1, dtype=jnp.int32) | _WALLS, (0, _WINDOW), constant_values=_SOLID)


def box_of_bits(piece: Array, rot: Array, px: Array) -> list[Array]:
    """The four rows of a piece's box, at its columns: int32 each."""
    mask = jnp.asarray(_MASKS)[piece, rot]
    rows = [mask >> (BOX * row) & ((1 << BOX) - 1) for row in range(BOX)]
    return [row << (px + MARGIN) for row in rows]


def is_free(box: list[Array], rows: Array) -> Array:
    """Whether a piece's box meets none of the blocks in four rows of bits, int32 [4]: a bool."""
    met = [box[row] & rows[row] for row in range(BOX)]  # term by term: a GPU needs no reduction
    return reduce(or_, met) == 0


def clear_rows(state: TetrisState, rules: Rules) -> tuple[TetrisState, Array]:
    """Remove the complete rows of a board on which a piece has just come to lie.

    Rows above fall straight down. Each line pays 0.1, by default up to the goal alone: the
    reference pays the whole of a clear that goes beyond it.

    Returns:
        The state with board and lines renewed, and the reward.
    """
    board = state.board
    row = jnp.arange(ROWS)
    bit = jnp.int32(1) << row
    full = jnp.sum(jnp.where(complete_rows(board) & state.just_locked, bit, 0))
    lines = state.lines + jax.lax.population_count(full)
    for _ in range(BOX):  # a piece completes four rows at most; the topmost goes first
        top = full & -full
        falls = (bit <= top)[:, None]
        board = jnp.where(falls, jnp.pad(board[:-1], ((1, 0), (0, 0))), board)
        full &= full - 1
    paid = lines - state.lines
    if rules == "default":
        paid = jnp.minimum(lines, GOAL) - jnp.minimum(state.lines, GOAL)
    return state._replace(board=board, lines=lines), LINE_REWARD * paid.astype(jnp.float32)


def spawn(key: Array, state: TetrisState, level: Params, rules: Rules) -> TetrisState:
    """Bring the next piece where one has just come to lie; the last preview is dealt from the
    bag.
    """
    dealt = state.bag[state.bag_index]
    index = (state.bag_index + 1) % PIECES
    bag = jnp.where(index == deal_order(level, rules)[1], shuffled(key), state.bag)
    fresh = state._replace(
        piece=state.next[0],
        px=jnp.full_like(state.px, SPAWN_X),
        py=jnp.full_like(state.py, SPAWN_Y),
        rot=jnp.zeros_like(state.rot),
        next=jnp.concatenate([state.next[1:], dealt[None]]),
        bag=bag,
        bag_index=index,
        just_locked=jnp.zeros_like(state.just_locked),
        frames_since_spawn=jnp.zeros_like(state.frames_since_spawn),
    )
    return TetrisState(
        *(jnp.where(state.just_locked, yes, no) for yes, no in zip(fresh, state, strict=True))
    )


def steer(state: TetrisState, action: Array, window: Array) -> TetrisState:
    """Turn or shift the piece, unless something is in the way; a turn that is blocked is not tried
    elsewhere.
    """
    rot = (state.rot + (action == UP)) % ROTATIONS
    px = state.px + (action == RIGHT).astype(jnp.int32) - (action == LEFT)
    free = is_free(box_of_bits(state.piece, rot, px), window[:BOX])
    return state._replace(rot=jnp.where(free, rot, state.rot), px=jnp.where(free, px, state.px))


def fall(
    state: TetrisState, action: Array, window: Array, level: Params, rules: Rules
) -> TetrisState:
    """Let the piece go down, and lock it where it cannot go one further.

    A soft drop replaces gravity; at the step of the spawn it goes down by one. What cannot go the
    whole way goes one cell, if that is free. By default every cell on the way has to be free, in
    the reference the last one alone.
    """
    box = box_of_bits(state.piece, state.rot, state.px)
    free = [is_free(box, window[down : down + BOX]) for down in range(_DEPTH + 1)]
    drop = jnp.where(state.frames_since_spawn == 0, 1, level.drop)
    wanted = jnp.where(action == DOWN, drop, level.fall)
    downs = range(1, _DEPTH + 1)
    if rules == "default":
        way_is_free = reduce(and_, [free[down] | (down > wanted) for down in downs])
    else:
        way_is_free = reduce(or_, [free[down] & (down == wanted) for down in downs])
    fallen = jnp.where(way_is_free, wanted, free[1].astype(jnp.int32))
    lies = ~reduce(or_, [free[down] & (down == fallen + 1) for down in downs])
    new = state._replace(py=state.py + fallen, just_locked=lies)
    tile = (state.piece + 1).astype(jnp.int8)
    return new._replace(board=jnp.where(covers(new) & lies, tile, new.board))


def step(
    key: Array, state: TetrisState, action: Array, level: Params, rules: Rules
) -> tuple[TetrisState, Array, Array, Array]:
    """Clear rows and bring the next piece where one lies, then act on the piece, then let it fall.

    Ends with ten lines, or when a new piece overlaps the pile, which costs 1 (not if the goal is
    reached at that very step; in the reference not at the time limit either). Cut at the time
    limit.
    """
    cleared, reward = clear_rows(state, rules)
    new = spawn(key, cleared, level, rules)
    window = jax.lax.dynamic_slice(rows_of_bits(new.board), (new.py,), (_WINDOW,))
    overlaps = ~is_free(box_of_bits(new.piece, new.rot, new.px), window[:BOX])
    terminal = state.just_locked & overlaps

    new = steer(new, action, window)
    new = fall(new, action, window, level, rules)
    age = jnp.minimum(new.frames_since_spawn + 1, MAX_AGE)
    new = new._replace(terminal=terminal, frames_since_spawn=age, time=state.time + 1)
    won = new.lines >= GOAL
    time_limit = new.time >= MAX_STEPS
    lost = terminal & ~won if rules == "default" else terminal & ~won & ~time_limit
    return new, reward + jnp.where(lost, TOP_OUT_REWARD, 0.0), terminal | won, time_limit
