"""The rules of Breakout: a ball moves one cell along a diagonal at every step; boards are indexed
[row, column].
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.game import LEFT, RIGHT, UNSET, Array, Rules

ROWS = 20
COLUMNS = 10
WALL_TOP = 1  # row of the uppermost bricks
WALL_ROWS = 6
BRICKS = WALL_ROWS * COLUMNS
PADDLE_ROW = ROWS - 1
START_ROW = 13  # of the ball
START_COLUMN = 5  # of the paddle's left end, where that leaves all of it on the board
MAX_STEPS = 2000

_WEIGHTS = (15, 13, 11, 9, 7, 5)
# by row; all bricks sum to 1
BRICK_REWARD = tuple(weight / (sum(_WEIGHTS) * COLUMNS) for weight in _WEIGHTS)


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    paddle: int  # width of the paddle in columns

    @property
    def right(self) -> int:
        """Rightmost column the paddle's left end can be in."""
        return COLUMNS - self.paddle


LEVELS = {"BreakoutEasy": Params(6), "BreakoutMedium": Params(5), "BreakoutHard": Params(4)}

UP_LEFT, UP_RIGHT, DOWN_RIGHT, DOWN_LEFT = range(4)
# A direction is turned round by changing these bits of it.
# left and right, both, up and down
SIDEWAYS = 1
AROUND = 2
UPRIGHT = 3


class BreakoutState(NamedTuple):
    """Ball, paddle, bricks and counters."""

    ball_x: Array  # int32, column
    ball_y: Array  # int32, row
    ball_dir: Array  # int32, UP_LEFT, UP_RIGHT, DOWN_RIGHT or DOWN_LEFT
    last_x: Array  # int32, column of the ball one step earlier
    last_y: Array  # int32, row of the ball one step earlier
    pos: Array  # int32, leftmost column of the paddle
    bricks: Array  # bool [WALL_ROWS, COLUMNS]
    strike: Array  # bool, whether the last step touched a brick
    score: Array  # int32, bricks paid
    time: Array  # int32, steps taken
    terminated: Array = UNSET  # bool, whether the game has ended
    truncated: Array = UNSET  # bool, whether the time limit was reached


def velocity(direction: Array) -> tuple[Array, Array]:
    """Columns and rows that the ball moves in a step: int32 scalars, 1 or -1."""
    dx = jnp.where((direction == UP_RIGHT) | (direction == DOWN_RIGHT), 1, -1)
    return dx, jnp.where(direction < DOWN_RIGHT, -1, 1)


def reset(key: Array, level: Params, rules: Rules, random_start: bool) -> BreakoutState:
    """All bricks, and the ball at one side wall, about to hit it; with ``random_start`` anywhere in
    its row.
    """
    for_side, for_column = jax.random.split(key)
    right = jax.random.bernoulli(for_side)
    x = jnp.where(right, COLUMNS - 1, 0)
    if random_start:
        x = jax.random.randint(for_column, (), 0, COLUMNS, dtype=jnp.int32)
    y = jnp.int32(START_ROW)
    zero = jnp.int32(0)
    pos = START_COLUMN if rules == "reference" else min(START_COLUMN, level.right)
    direction = jnp.where(right, UP_RIGHT, UP_LEFT)
    bricks = jnp.ones((WALL_ROWS, COLUMNS), bool)
    return BreakoutState(
        x, y, direction, x, y, jnp.int32(pos), bricks, jnp.bool_(False), zero, zero
    )


def step(
    state: BreakoutState, action: Array, level: Params, rules: Rules
) -> tuple[BreakoutState, Array, Array, Array]:
    """Move the paddle, then the ball.

    A brick that is touched vanishes and turns the ball round, unless the step before touched one as
    well: then the ball flies on through the gap. By default both pay; with ``rules="reference"``
    the second pays nothing and does not count.
    """
    sideways = (action == RIGHT).astype(jnp.int32) - (action == LEFT)
    # Only a move brings a paddle back that sticks out, as it can at the start of the reference.
    pos = jnp.where(sideways == 0, state.pos, jnp.clip(state.pos + sideways, 0, level.right))

    dx, dy = velocity(state.ball_dir)
    beside = state.ball_x + dx
    y = state.ball_y + dy
    x = jnp.clip(beside, 0, COLUMNS - 1)
    direction = state.ball_dir ^ jnp.where(beside != x, SIDEWAYS, 0)

    rows = jnp.arange(WALL_TOP, WALL_TOP + WALL_ROWS)[:, None]
    columns = jnp.arange(COLUMNS)
    touched = state.bricks & (rows == y) & (columns == x)
    touch = touched.any()
    bounce = touch & ~state.strike

    at_paddle = y == PADDLE_ROW
    met_behind = at_paddle & _covers(pos, state.ball_x, level)
    met_ahead = at_paddle & ~met_behind & _covers(pos, x, level)
    lost = at_paddle & ~met_behind & ~met_ahead

    direction ^= jnp.where((y < 0) | bounce | met_behind, UPRIGHT, jnp.where(met_ahead, AROUND, 0))
    y = jnp.where(bounce | met_behind | met_ahead, state.ball_y, jnp.maximum(y, 0))
    bricks = state.bricks & ~touched
    left = bricks.sum(dtype=jnp.int32)
    paid = touch if rules == "default" else bounce
    value = jnp.sum(touched * jnp.array(BRICK_REWARD, jnp.float32)[:, None])
    reward = jnp.where(paid, value, 0.0) - jnp.where(lost, left / jnp.float32(BRICKS), 0.0)
    new = BreakoutState(
        x,
        y,
        direction,
        state.ball_x,
        state.ball_y,
        pos,
        bricks,
        touch,
        state.score + paid,
        state.time + 1,
    )
    return new, reward, lost | (left == 0), new.time >= MAX_STEPS


def _covers(pos: Array, x: Array, level: Params) -> Array:
    """Whether a paddle at ``pos`` covers column ``x`` (bool scalar)."""
    return (x >= pos) & (x < pos + level.paddle)
