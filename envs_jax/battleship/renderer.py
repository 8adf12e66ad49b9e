"""The screen of BattleShip: a lined board of grey tiles, red crosses, black rings, a golden
cursor.
"""

import math

import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.battleship.rules import SHIP_CELLS, BattleShipState, Params
from arcade_torch.envs_jax.boards import cell_mask
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import (
    Layers,
    arc,
    blank,
    grid_layout,
    lined_board,
    number_slot,
    paint,
    titled_background,
)
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    BLACK,
    BRASS,
    GREY,
    NICKEL,
    ORANGE,
    RED,
    SKY,
    WHITE,
    Colour,
)

COVERED, HIT, MISS = range(3)
KINDS = 3  # tile codes: covered, hit, miss; the same again under the cursor


def cross_tile(side: int, thickness: int, colour: Colour) -> Picture:
    """A tile with both diagonals in red: uint8 [side, side, 3]."""
    step = np.arange(side)
    falling = np.abs(step[:, None] - step) <= thickness / math.sqrt(2)
    return paint(blank(side, side, colour), falling | falling[:, ::-1], RED)


def ring_tile(side: int, thickness: int, colour: Colour) -> Picture:
    """A tile with a black ring that touches its borders: uint8 [side, side, 3]."""
    radius = side / 2
    return arc(
        blank(side, side, colour), radius, radius, radius - thickness, radius, 0, 2 * math.pi, BLACK
    )


class Screen:
    """Everything on the screen of one BattleShip configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
    """

    def __init__(self, size: int, level: Params) -> None:
        self.layout = grid_layout(size, level.side)
        side = self.layout.tile
        thickness = size // 128
        tiles = []
        for colour in (NICKEL, BRASS):
            tiles += [
                blank(side, side, colour),
                cross_tile(side, thickness, colour),
                ring_tile(side, thickness, colour),
            ]
        background = titled_background(size, "BATTLESHIP", WHITE, SKY)
        background, self.board = lined_board(background, self.layout, tiles, GREY)
        self.score = number_slot(size, SHIP_CELLS, WHITE, ORANGE)
        self.layers = Layers(background, self.score, self.board)

    def draw(self, state: BattleShipState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. The POMDP twin shows the mark under the cursor
        alone.
        """
        cursor = cell_mask(state.x, state.y, self.layout.cells)
        is_visible = (state.guesses == 1) & (cursor | ~jnp.asarray(partial))
        mark = jnp.where(state.board == 1, HIT, MISS)
        codes = jnp.where(is_visible, mark, COVERED) + jnp.where(cursor, KINDS, 0)
        return self.layers.draw(state.hits, codes.T)  # boards are [x, y], pictures [row, column]
