"""From codes to a frame: a fixed background, and places that each show one of several pictures.

All pictures are cut into lines on the host, once, each as long as a line of the screen and zero
beside the picture. What runs at each step is one pass over the frame: a line of it is the exclusive
or of the lines that stand there, one a picture. So no byte needs an index of its own, lines are
read and written as whole vectors, and a compiler can give the frames of a batch to all cores. A
game only says which pictures it has and which code it wants shown.
"""

import functools
import operator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render.canvas import Picture, blank, rectangle
from arcade_torch.envs_jax.render.palette import Colour
from arcade_torch.envs_jax.render.text import (
    TEXT,
    centred,
    check_size,
    draw_name,
    number_pictures,
)
from arcade_torch.envs_jax.validation import format_value

WORD = 4  # bytes that a thread of a GPU combines at once


@dataclass(frozen=True, eq=False)
class Slot:
    """A place on the screen that shows one of several pictures of one size."""

    pictures: Picture  # uint8 [codes, h, w, 3]
    x: int  # left edge on the screen
    y: int  # top edge on the screen
    # the pictures are combined with what lies below, by exclusive or, instead of covering it
    mixed: bool = False

    @property
    def area(self) -> tuple[slice, slice]:
        """Rows and bytes of the screen that it takes."""
        height, width = self.pictures.shape[1:3]
        return slice(self.y, self.y + height), slice(3 * self.x, 3 * (self.x + width))

    def slots(self, shape: tuple[int, ...]) -> list["Slot"]:
        """The places for codes of a shape: this one, for a shape ()."""
        return [self]

    def read(self, frames: Picture) -> npt.NDArray[np.int64]:
        """Which picture each frame (uint8 [N, S, S, 3]) shows: int64 [N], -1 where none; on the
        host.
        """
        height, width = self.pictures.shape[1:3]
        cutouts = frames[:, self.y : self.y + height, self.x : self.x + width]
        return recognise(cutouts.reshape(len(frames), -1), self.pictures)


@dataclass(frozen=True, eq=False)
class TileGrid:
    """A rectangle of equal cells, each of which shows one tile of an atlas."""

    atlas: Picture  # uint8 [codes, h, w, 3]
    x: int
    y: int
    mixed: bool = False  # as in a slot

    def slots(self, shape: tuple[int, ...]) -> list[Slot]:
        """The places for codes of a shape (rows, columns): of all cells, row by row."""
        height, width = self.atlas.shape[1:3]
        cells = np.ndindex(*shape)
        return [
            Slot(self.atlas, self.x + width * c, self.y + height * r, self.mixed) for r, c in cells
        ]

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
        return recognise(
            np.ascontiguousarray(tiles).reshape(len(frames), rows, columns, -1), self.atlas
        )


def recognise(cutouts: npt.NDArray[np.uint8], pictures: Picture) -> npt.NDArray[np.int64]:
    """Which of some pictures each of many cut-outs is; on the host.

    Args:
        cutouts: uint8 [..., h * w * 3].
        pictures: uint8 [codes, h, w, 3].

    Returns:
        int64 [...]: the lowest code that looks like this, -1 where none does.
    """
    flat = pictures.reshape(len(pictures), -1)
    # Random weights give every picture a number of its own; whole numbers are summed without
    # rounding.
    weights = np.random.default_rng(0).integers(1, 2**24, flat.shape[1]).astype(np.float64)
    numbers = flat @ weights
    order = numbers.argsort(kind="stable")
    places = np.searchsorted(numbers, cutouts @ weights, sorter=order)
    codes = order[np.minimum(places, len(order) - 1)]
    return np.where((flat[codes] == cutouts).all(-1), codes, -1)


def combine_lines(lines: npt.NDArray[Any], index: Array) -> Array:
    """Combine the pictures of each line of the screen by exclusive or.

    Args:
        lines: Unsigned integers [M, W], all lines there are.
        index: uint32 [J, S], the number of each of the J lines that meet in a line of the screen.

    Returns:
        Of the type of ``lines``, [S, W].
    """
    table = jnp.asarray(lines)
    pictures = [table.at[numbers].get(mode="promise_in_bounds") for numbers in index]
    return functools.reduce(operator.xor, pictures)


def combine_words(lines: Picture, index: Array) -> Array:
    """Combine lines as :func:`combine_lines` does, four bytes at a time.

    XLA gives a thread of a GPU four elements. With words that is 16 bytes for the arithmetic of
    one index, so drawing takes a quarter of the instructions. On a CPU words are several times
    slower than bytes.

    Args:
        lines: uint8 [M, B], with a multiple of four for B.
        index: As for :func:`combine_lines`.

    Returns:
        uint8 [S, B].
    """
    words = combine_lines(lines.view(np.uint32), index)
    return jax.lax.bitcast_convert_type(words, jnp.uint8).reshape(len(words), -1)


class Layers:
    """A whole screen: a background and the places on it, of which a later one covers those before
    it.

    Args:
        background: uint8 [S, S, 3].
        *places: Slots and grids.

    Example:
        >>> from arcade_torch.envs_jax.render import Layers, Slot, blank
        >>> lamp = Slot(np.stack([blank(2, 2, (0, 0, 0)), blank(2, 2, (255, 0, 0))]), 3, 1)
        >>> Layers(blank(8, 8, (9, 9, 9)), lamp).draw(1)[1, 2:4].tolist()
        [[9, 9, 9], [255, 0, 0]]
    """

    def __init__(self, background: Picture, *places: Slot | TileGrid) -> None:
        self.background = background
        self.places = places
        self._tables = functools.cache(self._make_tables)

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is made anew, its tables too."""
        return type(self), (self.background, *self.places)

    def draw(self, *codes: Array | int) -> Array:
        """Show pictures by code.

        Args:
            *codes: One a place: int [] for a slot, int [rows, columns] for a grid.

        Returns:
            uint8 [S, S, 3].

        Raises:
            ValueError: Codes of a wrong shape, or without a picture. Under ``jit`` and ``vmap``
                nobody knows the codes, so there one without a picture draws anything.
        """
        arrays = [jnp.asarray(code) for code in codes]
        if len(arrays) != len(self.places):
            raise ValueError(f"got {len(arrays)} codes for {len(self.places)} places")
        for number, array in enumerate(arrays):
            if not isinstance(array, jax.core.Tracer):
                self._check_codes(number, np.asarray(array))
        lines, (slot, start, stride) = self._tables(tuple(array.shape for array in arrays))
        flat = [array.astype(jnp.uint32).reshape(-1) for array in arrays]
        code_of_slot = jnp.concatenate([*flat, jnp.zeros(1, jnp.uint32)])
        index = start + stride * code_of_slot.at[slot].get(mode="promise_in_bounds")
        by_bytes = functools.partial(combine_lines, lines)
        if lines.shape[1] % WORD:
            frame = by_bytes(index)
        else:
            by_words = functools.partial(combine_words, lines)
            frame = jax.lax.platform_dependent(index, cuda=by_words, default=by_bytes)
        return frame.reshape(self.background.shape)

    def _check_codes(self, number: int, codes: npt.NDArray[Any]) -> None:
        """Refuse codes of a place for which it has no picture."""
        place = self.places[number]
        pictures = place.pictures if isinstance(place, Slot) else place.atlas
        wrong = np.argwhere((codes < 0) | (codes >= len(pictures)))
        if not len(wrong):
            return
        cell = tuple(wrong[0].tolist())
        where = f", row {cell[0]}, column {cell[1]}," if len(cell) == 2 else ""
        raise ValueError(
            f"{self._name(number)}{where} has no picture {codes[cell]}: codes are 0 to "
            f"{len(pictures) - 1}"
        )

    def _check_shape(self, number: int, shape: tuple[int, ...]) -> None:
        """Refuse codes of a shape that a place does not take, and a place beyond the screen."""
        place = self.places[number]
        if isinstance(place, Slot) and shape:
            raise ValueError(f"{self._name(number)} wants a single code, got shape {list(shape)}")
        if isinstance(place, TileGrid) and len(shape) != 2:
            raise ValueError(
                f"{self._name(number)} wants codes [rows, columns], got shape {list(shape)}"
            )
        size = len(self.background)
        for slot in place.slots(shape)[-1:]:
            rows, across = slot.area
            right = across.stop // 3
            if place.x < 0 or place.y < 0 or right > size or rows.stop > size:
                raise ValueError(
                    f"{self._name(number)} does not fit the screen: it reaches to x {right}, "
                    f"y {rows.stop}, of {size}"
                )

    def _name(self, number: int) -> str:
        """A place in words."""
        place = self.places[number]
        return f"place {number} ({type(place).__name__} at x {place.x}, y {place.y})"

    def _make_tables(
        self, shapes: tuple[tuple[int, ...], ...]
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint32]]:
        """Cut the pictures into lines; the background is part of the first picture of each line.

        Returns:
            Lines, uint8 [M, 3 S], and uint32 [3, J, S], of J pictures in each line of the screen:
            the slot, and the numbers of the line for its code 0 and from there to the next code.
        """
        slots: list[Slot] = []
        for number, (place, shape) in enumerate(zip(self.places, shapes, strict=True)):
            self._check_shape(number, shape)
            slots.extend(place.slots(shape))
        below = self.background.reshape(len(self.background), -1)
        on_top = np.full(below.shape, -1)
        for number, slot in enumerate(slots):
            if not slot.mixed:
                on_top[slot.area] = number
        blocks: dict[bytes, int] = {}  # blocks of lines, and the number of their first line
        # what stands in each line of the screen: slot, line of its code 0, lines to the next code
        entries_of: list[list[tuple[int, int, int]]] = [[] for _ in below]

        def add(block: npt.NDArray[np.uint8]) -> int:
            next_line = sum(map(len, blocks)) // below.shape[1]
            return blocks.setdefault(block.tobytes(), next_line)

        for number, slot in enumerate(slots):
            rows, across = slot.area
            changes = slot.pictures.reshape(*slot.pictures.shape[:2], -1)
            if not slot.mixed:
                changes = np.where(
                    on_top[slot.area] == number, changes ^ below[slot.area], 0
                ).astype(np.uint8)
            seen = np.asarray(changes.any((0, 2)))
            block = np.zeros((len(changes), *below[rows].shape), np.uint8)
            block[:, :, across] = changes
            first = seen & [not entries for entries in entries_of[rows]]
            block[:, first] ^= below[rows][first]
            start = add(block)
            for row in np.flatnonzero(seen).tolist():
                entries_of[slot.y + row].append((number, start + row, len(seen)))
        for line, entries in zip(below, entries_of, strict=True):
            if not entries:
                entries.append((0, add(line), 0))
        nothing = (0, add(np.zeros_like(below[0])), 0)
        most = max(map(len, entries_of))
        padded = [entries + [nothing] * (most - len(entries)) for entries in entries_of]
        table = np.array(padded, np.uint32).transpose(2, 1, 0)
        lines = np.frombuffer(b"".join(blocks), np.uint8).reshape(-1, below.shape[1])
        return lines, table


def number_slot(size: int, highest: int, background: Colour, colour: Colour) -> Slot:
    """The number at the top of a screen, for values 0 to ``highest``; see ``number_pictures``."""
    layout = TEXT[size]
    return Slot(
        number_pictures(size, highest, background, colour), layout.field_x[0], layout.field_y[0]
    )


def titled_background(size: int, name: str, outer: Colour, name_colour: Colour) -> Picture:
    """A screen of one colour with the game's name in the band at the bottom: uint8 [size, size,
    3].
    """
    return draw_name(blank(size, size, outer), name, name_colour)


GRID_LINE = 2
# side of the square between number and title
_BOARD_SIDE = {128: 98, 256: 196}
# as published; other boards get the largest tiles that fit
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
    """Layout of a board with ``cells`` cells a side on a screen of ``size`` pixels.

    Args:
        size: Side of the screen, 128 or 256.
        cells: Cells a side, 1 to 32 on 128 pixels, 1 to 64 on 256.

    Raises:
        ValueError: Another size or number of cells.

    Example:
        >>> grid_layout(128, 3)
        GridLayout(cells=3, tile=30, offset=15)
    """
    check_size(size)
    room = _BOARD_SIDE[size] - GRID_LINE
    most = room // (GRID_LINE + 1)
    if not isinstance(cells, int) or not 1 <= cells <= most:
        raise ValueError(
            f"cells is {format_value(cells)}, a screen of {size} pixels takes 1 to {most}"
        )
    largest = room // cells - GRID_LINE
    tile = _TILE_SIDE[size].get(cells, largest)
    return GridLayout(cells, tile, centred(size, cells * (tile + GRID_LINE) + GRID_LINE))


def lined_board(
    background: Picture, layout: GridLayout, tiles: list[Picture], line: Colour
) -> tuple[Picture, TileGrid]:
    """A board with grid lines: every tile carries the line before it, the closing lines belong to
    the background.

    Args:
        background: The screen, uint8 [S, S, 3]; changed in place.
        layout: Where the board stands.
        tiles: One picture a code, uint8 [tile, tile, 3] each.
        line: Colour of the grid lines.

    Returns:
        The background with the board's square filled with the line colour, and the grid of tiles.

    Raises:
        ValueError: A tile of another size.
    """
    for code, tile in enumerate(tiles):
        if tile.shape != (layout.tile, layout.tile, 3):
            raise ValueError(
                f"tile {code} is {tile.dtype} {list(tile.shape)}, the layout wants "
                f"[{layout.tile}, {layout.tile}, 3]"
            )
    low = layout.offset
    high = layout.offset + layout.side
    rectangle(background, low, low, high, high, line)
    atlas = np.stack([blank(layout.pitch, layout.pitch, line) for _ in tiles])
    for picture, tile in zip(atlas, tiles, strict=True):
        picture[GRID_LINE:, GRID_LINE:] = tile
    return background, TileGrid(atlas, low, low)
