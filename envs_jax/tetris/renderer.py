"""The screen of Tetris: a well between two walls, framed cells, small previews at its right."""

import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import (
    Layers,
    Slot,
    TileGrid,
    blank,
    centred,
    number_slot,
    rectangle,
    titled_background,
)
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    AMBER,
    ASH,
    BLACK,
    BLOOD,
    COBALT,
    EMERALD,
    GOLD,
    LAGOON,
    SCARLET,
    VIOLET,
    WHITE,
    YELLOW,
    Colour,
)
from arcade_torch.envs_jax.tetris.rules import (
    BOX,
    COLUMNS,
    GOAL,
    ROWS,
    SHAPES,
    Params,
    TetrisState,
    complete_rows,
    covers,
)

# I O T S Z J L
PIECE_COLOURS: tuple[Colour, ...] = (LAGOON, GOLD, VIOLET, EMERALD, BLOOD, COBALT, AMBER)
# tile codes: empty, the pieces, a cell of a complete row
EMPTY = 0
BAND = 1 + len(PIECE_COLOURS)
MOST_LINES = GOAL + 3  # nine lines, then a clear of four
BAND_OVERHANG = 2  # pixels of a band beyond the board, on either side


def framed_cell(side: int, colour: Colour) -> Picture:
    """A cell with a white frame of one pixel: uint8 [side, side, 3]."""
    return rectangle(blank(side, side, WHITE), 1, 1, side - 1, side - 1, colour)


def preview_picture(piece: int, side: int) -> Picture:
    """A coming piece in its box, with cells of ``side`` pixels; those of two pixels have no room
    for a frame.
    """
    colour = PIECE_COLOURS[piece]
    cell = framed_cell(side, colour) if side > 2 else blank(side, side, colour)
    picture = blank(BOX * side, BOX * side, BLACK)
    for row, column in np.argwhere(SHAPES[piece, 0]):
        picture[row * side : (row + 1) * side, column * side : (column + 1) * side] = cell
    return picture


class Screen:
    """Everything on the screen of one Tetris configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
    """

    def __init__(self, size: int, level: Params) -> None:
        self.cell = cell = {128: 5, 256: 10}[size]
        field = ROWS * cell  # the black square is as wide as the board is high
        corner = centred(size, field)
        left = corner + 5 * cell
        right = corner + (5 + COLUMNS) * cell
        background = titled_background(size, "TETRIS", ASH, YELLOW)
        rectangle(background, corner, corner, corner + field, corner + field, BLACK)
        rectangle(background, left - 1, corner, left, corner + field, WHITE)
        rectangle(background, right, corner, right + 1, corner + field, WHITE)

        tiles = [
            blank(cell, cell, BLACK),
            *(framed_cell(cell, c) for c in PIECE_COLOURS),
            blank(cell, cell, WHITE),
        ]
        self.board = TileGrid(np.stack(tiles), left, corner)
        # The ends of a band: what is there without it, and white.
        self.band_ends = [
            TileGrid(
                np.stack([background[corner : corner + cell, x : x + BAND_OVERHANG], ends]),
                x,
                corner,
            )
            for ends in [blank(cell, BAND_OVERHANG, WHITE)]
            for x in (left - BAND_OVERHANG, right)
        ]
        small = cell // 2
        pictures = np.stack([preview_picture(piece, small) for piece in range(len(PIECE_COLOURS))])
        self.previews = [
            Slot(pictures, corner + 16 * cell, corner + 3 * cell + 2 + 3 * cell * k)
            for k in range(level.previews)
        ]
        self.score = number_slot(size, MOST_LINES, ASH, SCARLET)
        # The number field reaches one or two rows into the well: the board is drawn over it.
        self.layers = Layers(background, self.score, self.board, *self.band_ends, *self.previews)

    def codes(self, state: TetrisState, partial: Array | bool) -> Array:
        """What each cell shows, int8 [20, 10]. The POMDP twin shows the piece and complete rows
        alone.
        """
        pile = jnp.where(jnp.asarray(partial), EMPTY, state.board)
        cells = jnp.where(covers(state), (state.piece + 1).astype(jnp.int8), pile)
        return jnp.where(complete_rows(state.board)[:, None], jnp.int8(BAND), cells)

    def draw(self, state: TetrisState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]."""
        full = complete_rows(state.board)[:, None]
        previews = [state.next[k] for k in range(len(self.previews))]
        return self.layers.draw(state.lines, self.codes(state, partial), full, full, *previews)
