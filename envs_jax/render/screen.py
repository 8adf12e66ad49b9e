"""From codes to a frame: a fixed background, and pictures gathered from atlases into fixed places.

All of it is built once on the host; what runs at each step is one gather for each place. The host parts (numpy) and the
running parts (JAX) of a place stand together, so that a game only says which pictures it has and which code it wants
shown.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render.canvas import Picture, blank, rectangle
from arcade_torch.envs_jax.render.palette import Colour
from arcade_torch.envs_jax.render.text import TEXT, centred, draw_name, number_pictures


def gather(atlas: Array, index: Array) -> Array:
    """Rows of an atlas, without a bounds check: indices must be within it."""
    return atlas.at[index].get(mode="promise_in_bounds")


def place(frame: Array, block: Array, x: int, y: int) -> Array:
    """Put a block of pixels (uint8 [h, w, 3]) at a fixed place of a frame."""
    return jax.lax.dynamic_update_slice(frame, block, (y, x, 0))


@dataclass(frozen=True, eq=False)
class Slot:
    """A place on the screen that shows one of several pictures of one size."""

    pictures: Picture  # uint8 [codes, h, w, 3]
    x: int  # left edge on the screen
    y: int  # top edge on the screen

    def draw(self, frame: Array, code: Array) -> Array:
        """Show picture ``code`` (int scalar) on ``frame`` (uint8 [S, S, 3])."""
        return place(frame, gather(jnp.asarray(self.pictures), code), self.x, self.y)

    def read(self, frames: Picture) -> npt.NDArray[np.int64]:
        """Which picture each frame (uint8 [N, S, S, 3]) shows: int64 [N], -1 where none; on the host."""
        height, width = self.pictures.shape[1:3]
        shown = frames[:, self.y : self.y + height, self.x : self.x + width]
        return recognise(shown.reshape(len(frames), -1), self.pictures)


@dataclass(frozen=True, eq=False)
class TileGrid:
    """A rectangle of equal cells, each of which shows one tile of an atlas."""

    atlas: Picture  # uint8 [codes, h, w, 3]
    x: int
    y: int

    def draw(self, frame: Array, codes: Array) -> Array:
        """Show tiles ``codes`` (int [rows, columns]) on ``frame`` (uint8 [S, S, 3])."""
        rows, columns = codes.shape
        height, width = self.atlas.shape[1:3]
        tiles = gather(jnp.asarray(self.atlas), codes)
        block = tiles.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, 3)
        return place(frame, block, self.x, self.y)

    def read(self, frames: Picture, rows: int, columns: int) -> npt.NDArray[np.int64]:
        """Which tiles frames show, by comparing them with the atlas; on the host.

        Args:
            frames: uint8 [N, S, S, 3].
            rows: Rows of the grid.
            columns: Columns of the grid.

        Returns:
            int64 [N, rows, columns]: the lowest code that looks like this, -1 where none does.
        """
        height, width = self.atlas.shape[1:3]
        area = frames[:, self.y : self.y + rows * height, self.x : self.x + columns * width]
        tiles = area.reshape(len(frames), rows, height, columns, width, 3).swapaxes(2, 3)
        return recognise(np.ascontiguousarray(tiles).reshape(len(frames), rows, columns, -1), self.atlas)


def recognise(shown: npt.NDArray[np.uint8], pictures: Picture) -> npt.NDArray[np.int64]:
    """Which of some pictures each of many cut-outs is; on the host.

    Args:
        shown: uint8 [..., h * w * 3], the cut-outs.
        pictures: uint8 [codes, h, w, 3].

    Returns:
        int64 [...]: the lowest code that looks like this, -1 where none does.
    """
    known = pictures.reshape(len(pictures), -1)
    # Random weights give every picture a number of its own; whole numbers are summed without rounding.
    weights = np.random.default_rng(0).integers(1, 2**24, known.shape[1]).astype(np.float64)
    numbers = known @ weights
    order = numbers.argsort(kind="stable")
    found = np.searchsorted(numbers, shown @ weights, sorter=order)
    codes = order[np.minimum(found, len(order) - 1)]
    return np.where((known[codes] == shown).all(-1), codes, -1)


def number_slot(size: int, highest: int, background: Colour, colour: Colour) -> Slot:
    """The number at the top of a screen, for values 0 to ``highest``."""
    layout = TEXT[size]
    return Slot(number_pictures(size, highest, background, colour), layout.field_x[0], layout.field_y[0])


def titled_background(size: int, name: str, outer: Colour, name_colour: Colour) -> Picture:
    """A screen of one colour with the game's name in the band at the bottom: uint8 [size, size, 3]."""
    return draw_name(blank(size, size, outer), name, name_colour)


GRID_LINE = 2
_TILE_SIDE = {
    128: {4: 21, 6: 13, 8: 9, 10: 7, 12: 6},
    256: {4: 44, 6: 28, 8: 21, 10: 17, 12: 13},
}


@dataclass(frozen=True)
class GridLayout:
    """Where a square board of tiles stands on a screen, in pixels."""

    cells: int  # cells per side
    tile: int  # side of a tile without its line
    offset: int  # left and top edge of the board on the screen

    @property
    def pitch(self) -> int:
        """Distance between neighbouring tiles: a tile and the line before it."""
        return self.tile + GRID_LINE

    @property
    def side(self) -> int:
        """Side of the whole board, lines included."""
        return self.cells * self.pitch + GRID_LINE


def grid_layout(size: int, cells: int) -> GridLayout:
    """Layout of a board with ``cells`` cells a side on a screen of ``size`` pixels."""
    tile = _TILE_SIDE[size][cells]
    return GridLayout(cells, tile, centred(size, cells * (tile + GRID_LINE) + GRID_LINE))


def lined_board(
    background: Picture, layout: GridLayout, tiles: list[Picture], line: Colour
) -> tuple[Picture, TileGrid]:
    """A board with grid lines: every tile carries the line before it, the closing lines belong to the background.

    Args:
        background: The screen, uint8 [S, S, 3]; changed in place.
        layout: Where the board stands.
        tiles: One picture a code, uint8 [tile, tile, 3] each.
        line: Colour of the grid lines.

    Returns:
        The background with the board's square filled with the line colour, and the grid of tiles.
    """
    low, high = layout.offset, layout.offset + layout.side
    rectangle(background, low, low, high, high, line)
    atlas = np.stack([blank(layout.pitch, layout.pitch, line) for _ in tiles])
    for picture, tile in zip(atlas, tiles, strict=True):
        picture[GRID_LINE:, GRID_LINE:] = tile
    return background, TileGrid(atlas, low, low)
