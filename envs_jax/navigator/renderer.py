"""The screen of Navigator: a lined map with blocks of TNT, a hexagonal treasure, and the agent as a
yellow square.
"""

import math

import jax.numpy as jnp

from arcade_torch.envs_jax.boards import cell_mask
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.navigator.rules import FREE, NavigatorState, Params
from arcade_torch.envs_jax.render import (
    Layers,
    bitmap,
    blank,
    centred,
    grid_layout,
    lined_board,
    number_slot,
    polygon,
    rectangle,
    titled_background,
)
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    BLACK,
    MAUVE,
    MIDNIGHT,
    PLUM,
    RED,
    SKY,
    SLATE,
    WHITE,
    YELLOW,
)

KINDS = 3  # tile codes: free, TNT, treasure; the same again under the agent
AGENT_SHARE = 0.6  # side of the agent's square in tiles

# "TNT" for tiles of at least the given side; what is smaller has room for strokes only.
_LETTERS = (
    (
        21,
        (
            "11111010001011111",
            "00100011001000100",
            "00100010101000100",
            "00100010011000100",
            "00100010001000100",
        ),
    ),
    (13, ("1110100010111", "0100110010010", "0100101010010", "0100100110010", "0100100010010")),
    (9, ("1001001", "1001001", "1001001")),
    (7, ("10101", "10101", "10101")),
    (6, ("1001", "1001")),
)


def _nearest(length: float, side: int) -> int:
    """The whole length nearest to the one given that can stand exactly in the middle of a tile."""
    return min(range(side, 0, -2), key=lambda whole: abs(whole - length))


def tnt_tile(side: int) -> Picture:
    """A red tile with black letters on a white band over its middle third: uint8 [side, side,
    3].
    """
    letters = next(rows for least, rows in _LETTERS if side >= least)
    band = _nearest(side / 3, side)
    top = centred(side, band)
    picture = rectangle(blank(side, side, RED), 0, top, side, top + band, WHITE)
    x = centred(side, len(letters[0]))
    y = centred(side, len(letters))
    return bitmap(picture, letters, x, y, 1, 1, BLACK)


def treasure_tile(side: int) -> Picture:
    """A tile with the largest hexagon that fits: uint8 [side, side, 3]."""
    radius = side / 2
    turns = [math.pi / 3 * k for k in range(6)]
    corners = [(radius * (1 + math.cos(turn)), radius * (1 + math.sin(turn))) for turn in turns]
    return polygon(blank(side, side, MAUVE), corners, SKY)


def with_agent(tile: Picture) -> Picture:
    """The tile with the agent's square in its middle; the rim still tells what lies below."""
    side = len(tile)
    square = _nearest(AGENT_SHARE * side, side)
    start = centred(side, square)
    return rectangle(tile.copy(), start, start, start + square, start + square, YELLOW)


class Screen:
    """Everything on the screen of one Navigator configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
    """

    def __init__(self, size: int, level: Params) -> None:
        self.layout = grid_layout(size, level.side)
        side = self.layout.tile
        tiles = [blank(side, side, MAUVE), tnt_tile(side), treasure_tile(side)]
        tiles += [with_agent(tile) for tile in tiles]
        background = titled_background(size, "NAVIGATOR", SLATE, PLUM)
        zero = number_slot(size, 0, SLATE, MIDNIGHT)  # the published score, which never changes
        height, width = zero.pictures.shape[1:3]
        background[zero.y : zero.y + height, zero.x : zero.x + width] = zero.pictures[0]
        background, self.board = lined_board(background, self.layout, tiles, WHITE)
        self.layers = Layers(background, self.board)

    def draw(self, state: NavigatorState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. From step 1 on, the POMDP twin shows the agent on
        an empty map.
        """
        agent = cell_mask(state.x, state.y, self.layout.cells)
        hidden = jnp.asarray(partial) & (state.timestep > 0)
        codes = jnp.where(hidden, FREE, state.board) + jnp.where(agent, KINDS, 0)
        return self.layers.draw(codes.T)  # boards are [x, y], pictures [row, column]
