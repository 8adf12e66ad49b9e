"""The screen of Signpost: a sign with an arrow, a corridor below it, and at its end a gate."""

import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import (
    Layers,
    Slot,
    TileGrid,
    blank,
    centred,
    disc,
    number_slot,
    polygon,
    rectangle,
    titled_background,
)
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    BLACK,
    GREY,
    NAVY,
    ORANGE,
    SPRING_GREEN,
    WHITE,
    YELLOW,
)
from arcade_torch.envs_jax.signpost.rules import SIGNS, Params, SignpostState

# tile codes; the same again under the walker
FLOOR = 0
GATE = 1
OPEN = 2
KINDS = 3
BLANK = SIGNS  # picture of the sign with nothing on it


def sign_pictures(side: int) -> Picture:
    """Arrows up, down, left, right, and an empty sign: uint8 [5, side, side, 3]."""
    empty = rectangle(blank(side, side, WHITE), 1, 1, side - 1, side - 1, NAVY)
    up = empty.copy()
    half = side / 2
    polygon(up, [(half, side / 8), (side * 7 / 8, half), (side / 8, half)], YELLOW)
    rectangle(up, side * 3 // 8, side // 2, side - side * 3 // 8, side * 7 // 8, YELLOW)
    left = np.rot90(up)
    return np.stack([up, up[::-1], left, left[:, ::-1], empty])


def tiles(side: int) -> Picture:
    """Floor, gate, open gate, and each with the walker on it: uint8 [6, side, side, 3]."""
    plain = [
        rectangle(blank(side, side, GREY), 1, 1, side - 1, side - 1, c)
        for c in (BLACK, ORANGE, SPRING_GREEN)
    ]
    walked = [disc(tile.copy(), side / 2, side / 2, side * 0.3, WHITE) for tile in plain]
    return np.stack(plain + walked)


class Screen:
    """Everything on the screen of one Signpost configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
    """

    def __init__(self, size: int, level: Params) -> None:
        self.cells = level.cells
        tile = size * 3 // 4 // level.cells
        background = titled_background(size, "SIGNPOST", BLACK, WHITE)
        self.sign = Slot(sign_pictures(size // 4), centred(size, size // 4), size // 4)
        self.corridor = TileGrid(tiles(tile), centred(size, tile * level.cells), size * 5 // 8)
        self.score = number_slot(size, 1, BLACK, SPRING_GREEN)
        self.layers = Layers(background, self.score, self.sign, self.corridor)

    def draw(self, state: SignpostState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. From step 1 on, the POMDP twin shows an empty
        sign.
        """
        hidden = jnp.asarray(partial) & (state.timestep > 0)
        cell = jnp.arange(self.cells)
        codes = jnp.where(cell == self.cells - 1, GATE + state.score, FLOOR) + KINDS * (
            cell == state.x
        )
        return self.layers.draw(state.score, jnp.where(hidden, BLANK, state.sign), codes[None])
