"""The screen of Breakout: rows of coloured bricks, a paddle, a ball, and a tail that tells where
the ball goes.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.breakout.rules import (
    BRICKS,
    COLUMNS,
    DOWN_RIGHT,
    PADDLE_ROW,
    ROWS,
    WALL_ROWS,
    WALL_TOP,
    BreakoutState,
    Params,
    velocity,
)
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import (
    Layers,
    TileGrid,
    blank,
    centred,
    disc,
    number_slot,
    rectangle,
    titled_background,
)
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    BLACK,
    BRICK_RED,
    FLAME,
    INDIGO,
    LIME,
    OLIVE,
    RUST,
    SCARLET,
    SLATE,
    TANGERINE,
    YELLOW,
    Colour,
)

Tail = Literal["direction", "previous"]
TAILS: tuple[Tail, ...] = ("direction", "previous")

WALL_COLOURS: tuple[Colour, ...] = (BRICK_RED, RUST, TANGERINE, OLIVE, LIME, INDIGO)
PADDLE = 1 + WALL_ROWS
KINDS = PADDLE + 1  # what fills a cell: nothing, a brick of row 1 to 6, the paddle
# What is drawn over it; a code is kind + KINDS * mark. A tail beyond the board is drawn at the edge
# before it.
MARKS = (
    "",
    "ball",
    "tail",
    "tail left",
    "tail right",
    "tail top",
    "ball, tail",
    "ball, tail top left",
    "ball, tail top right",
)
NO_MARK, BALL, TAIL, TAIL_LEFT, TAIL_RIGHT, TAIL_TOP, BALL_TAIL, BALL_TOP_LEFT, BALL_TOP_RIGHT = (
    range(len(MARKS))
)


def _dot(picture: Picture, x: int, y: int, radius: int, colour: Colour) -> None:
    """A disc around the middle of a pixel."""
    disc(picture, x + 0.5, y + 0.5, radius, colour)


def cell_pictures(size: int) -> Picture:
    """Every cell that can be: uint8 [KINDS * marks, h, w, 3]."""
    unit = size // 128
    height = 5 * unit
    width = 10 * unit
    ball, tail = {128: (1, 1), 256: (3, 2)}[size]
    pictures = []
    for mark in MARKS:
        for colour in (BLACK, *WALL_COLOURS, BRICK_RED):
            cell = blank(height, width, colour)
            if "ball" in mark:
                _dot(cell, width // 2, height // 2, ball, BRICK_RED)
            if "tail" in mark:
                x = tail if "left" in mark else width - 1 - tail if "right" in mark else width // 2
                _dot(cell, x, tail if "top" in mark else height // 2, tail, FLAME)
            pictures.append(cell)
    return np.stack(pictures)


class Screen:
    """Everything on the screen of one Breakout configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
        tail: Where the tail is, see :class:`~arcade_torch.envs_jax.breakout.Breakout`.
    """

    def __init__(self, size: int, level: Params, tail: Tail) -> None:
        self.paddle = level.paddle
        self.tail = tail
        atlas = cell_pictures(size)
        field = atlas.shape[2] * COLUMNS
        low = centred(size, field)
        background = titled_background(size, "BREAKOUT", SLATE, YELLOW)
        rectangle(background, low, low, low + field, low + field, BLACK)
        self.board = TileGrid(atlas, low, low)
        self.score = number_slot(size, BRICKS, SLATE, SCARLET)
        self.layers = Layers(background, self.score, self.board)

    def draw(self, state: BreakoutState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. The POMDP twin shows no tail, and the ball only on
        its way up.
        """
        hidden = jnp.asarray(partial)
        columns = np.arange(COLUMNS)
        wall = jnp.where(state.bricks, np.arange(1, PADDLE)[:, None], 0)
        paddle = jnp.where((columns >= state.pos) & (columns < state.pos + self.paddle), PADDLE, 0)
        kinds = jnp.pad(wall, ((WALL_TOP, ROWS - WALL_TOP - WALL_ROWS), (0, 0)))
        kinds = jnp.where(np.arange(ROWS)[:, None] == PADDLE_ROW, paddle, kinds)

        (tail_x, tail_y), mark = self._tail(state)
        ball = _cell(state.ball_x, state.ball_y) & (~hidden | (state.ball_dir < DOWN_RIGHT))
        tail = _cell(tail_x, tail_y) & ~hidden
        both = jnp.where(
            mark == TAIL_TOP, jnp.where(state.ball_x == 0, BALL_TOP_LEFT, BALL_TOP_RIGHT), BALL_TAIL
        )
        marks = jnp.where(ball & tail, both, jnp.where(ball, BALL, jnp.where(tail, mark, NO_MARK)))
        return self.layers.draw(state.score, kinds + KINDS * marks)

    def _tail(self, state: BreakoutState) -> tuple[tuple[Array, Array], Array]:
        """Cell (x, y) of the tail, and how it is marked when it is alone there."""
        if self.tail == "previous":
            return (state.last_x, state.last_y), jnp.int32(TAIL)
        dx, dy = velocity(state.ball_dir)
        x = state.ball_x - dx
        y = state.ball_y - dy
        beside = jnp.where(x < 0, TAIL_LEFT, jnp.where(x >= COLUMNS, TAIL_RIGHT, TAIL))
        return (jnp.clip(x, 0, COLUMNS - 1), jnp.clip(y, 0, ROWS - 1)), jnp.where(
            y < 0, TAIL_TOP, beside
        )


def _cell(x: Array, y: Array) -> Array:
    """The cell in column ``x`` of row ``y``: bool [ROWS, COLUMNS]."""
    return (jnp.arange(ROWS)[:, None] == y) & (jnp.arange(COLUMNS) == x)
