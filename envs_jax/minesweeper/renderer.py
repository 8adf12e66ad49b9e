"""The screen of MineSweeper: a lined board of black tiles, white numbers, an orange cursor."""

import jax.numpy as jnp

from arcade_torch.envs_jax.boards import cell_mask
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.minesweeper.rules import SWEPT, MineSweeperState, Params
from arcade_torch.envs_jax.render import (
    DIGITS,
    PATTERN,
    Layers,
    bitmap,
    blank,
    centred,
    grid_layout,
    lined_board,
    number_slot,
    titled_background,
)
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    BLACK,
    GREY,
    MIST,
    NAVY,
    ORANGE,
    PURPLE,
    WHITE,
    Colour,
)

NUMBERS = 10  # a swept cell shows 0 to 8, a mine just hit 1 to 9
KINDS = 1 + NUMBERS  # tile codes: covered, then the numbers; the same again under the cursor


def number_tile(side: int, number: int, colour: Colour) -> Picture:
    """A tile with a number as large as fits with a margin of one pixel: uint8 [side, side, 3]."""
    scale = (side - 2) // PATTERN
    start = centred(side, PATTERN * scale)
    return bitmap(blank(side, side, colour), DIGITS[number], start, start, scale, scale, WHITE)


class Screen:
    """Everything on the screen of one MineSweeper configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
    """

    def __init__(self, size: int, level: Params) -> None:
        self.layout = grid_layout(size, level.side)
        side = self.layout.tile
        tiles = []
        for colour in (BLACK, ORANGE):
            tiles += [blank(side, side, colour)] + [
                number_tile(side, number, colour) for number in range(NUMBERS)
            ]
        background = titled_background(size, "MINESWEEPER", MIST, NAVY)
        background, self.board = lined_board(background, self.layout, tiles, GREY)
        self.score = number_slot(size, level.safe, MIST, PURPLE)
        self.layers = Layers(background, self.score, self.board)

    def draw(self, state: MineSweeperState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. The POMDP twin shows the number under the cursor
        alone.
        """
        cursor = cell_mask(state.x, state.y, self.layout.cells)
        is_visible = (state.grid == SWEPT) & (cursor | ~jnp.asarray(partial))
        codes = jnp.where(is_visible, 1 + state.neighbours, 0) + jnp.where(cursor, KINDS, 0)
        return self.layers.draw(state.score, codes.T)  # boards are [x, y], pictures [row, column]
