"""From codes to a frame: a fixed background, and places that each show one of several pictures.

All pictures are built once on the host, as rows of bytes that are as long as a part of a row of the screen. What runs
at each step is one pass over the frame, in which every part of a row is the exclusive or of a few such rows. Rows are
long enough to be read as whole vectors, no byte needs an index of its own, and a compiler can give the rows of a batch
to all cores. A game only says which pictures it has and which code it wants shown.
"""

import functools
import operator
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render.canvas import Picture, blank, rectangle
from arcade_torch.envs_jax.render.palette import Colour
from arcade_torch.envs_jax.render.text import TEXT, centred, draw_name, number_pictures


# What drawing costs on one core, by which rows are cut into parts: an index, and a byte of a row (Zen 5, AVX-512).
_INDEX_NS, _BYTE_NS = 0.8, 0.26 / 32
_LEAST_BYTES = 96  # shorter rows are copied byte by byte


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
    mixed: bool = False  # the pictures are combined with what lies below, by exclusive or, instead of covering it

    def draw(self, frame: Array, code: Array) -> Array:
        """Show picture ``code`` (int scalar) on ``frame`` (uint8 [S, S, 3]). ``Layers`` draws a whole screen faster."""
        return place(frame, gather(jnp.asarray(self.pictures), code), self.x, self.y)

    @property
    def area(self) -> tuple[slice, slice]:
        """Rows and bytes of the screen that it takes."""
        height, width = self.pictures.shape[1:3]
        return slice(self.y, self.y + height), slice(3 * self.x, 3 * (self.x + width))

    def slots(self, shape: tuple[int, ...]) -> list["Slot"]:
        """This place, for a code of shape ()."""
        return [self]

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

    def slots(self, shape: tuple[int, ...]) -> list[Slot]:
        """The places of all cells, row by row, for codes of a shape (rows, columns)."""
        height, width = self.atlas.shape[1:3]
        return [Slot(self.atlas, self.x + width * c, self.y + height * r) for r, c in np.ndindex(*shape)]

    def draw(self, frame: Array, codes: Array) -> Array:
        """Show tiles ``codes`` (int [rows, columns]) on ``frame`` (uint8 [S, S, 3]). ``Layers`` is faster."""
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


class _Plan(NamedTuple):
    """What a screen is drawn from: layer J, part G of row S shows ``rows[start + stride * codes[slot]]``."""

    rows: npt.NDArray[np.uint8]  # [M, U], U bytes are a part of a row of the screen
    slot: npt.NDArray[np.uint32]  # [J, S, G]
    start: npt.NDArray[np.uint32]
    stride: npt.NDArray[np.uint32]


class Layers:
    """A whole screen: a background and the places on it, of which a later one covers those before it.

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
        self.background, self.places = background, places
        self._plan = functools.cache(self._make_plan)

    def draw(self, *codes: Array | int) -> Array:
        """Show pictures by code, int [] for a slot and int [rows, columns] for a grid: uint8 [S, S, 3]."""
        arrays = [jnp.asarray(code) for code in codes]
        plan = self._plan(tuple(array.shape for array in arrays))
        flat = apart(jnp.concatenate([array.astype(jnp.int32).reshape(-1) for array in arrays]))
        index = plan.start + plan.stride * gather(flat, plan.slot).astype(jnp.uint32)
        layers = [gather(jnp.asarray(plan.rows), layer) for layer in index]
        return functools.reduce(operator.xor, layers).reshape(self.background.shape)

    def _make_plan(self, shapes: tuple[tuple[int, ...], ...]) -> _Plan:
        """Cut rows into so many parts that a frame costs least, and fill the tables."""
        slots = [slot for place, shape in zip(self.places, shapes, strict=True) for slot in place.slots(shape)]
        below = self.background.reshape(len(self.background), -1)
        owner = np.full(below.shape, -1)  # which slot is on top
        for number, slot in enumerate(slots):
            if not slot.mixed:
                owner[slot.area] = number
        width = below.shape[1]
        plans = []
        for parts in range(1, max(1, width // _LEAST_BYTES) + 1):
            if width % parts == 0:
                plans.append(_plan(slots, owner, below, width // parts))
        return min(plans, key=lambda plan: plan.slot.size * (_INDEX_NS + plan.rows.shape[1] * _BYTE_NS))


def _plan(slots: list[Slot], owner: npt.NDArray[np.int64], below: npt.NDArray[np.uint8], length: int) -> _Plan:
    """The tables for parts of ``length`` bytes; a part of the background is in the first layer that is over it."""
    size, parts = len(below), below.shape[1] // length
    rows: list[npt.NDArray[np.uint8]] = []
    found: dict[bytes, int] = {}
    layers = np.zeros((size, parts), int)  # so far
    entries = []

    def row_number(block: npt.NDArray[np.uint8]) -> int:
        key = block.tobytes()
        if key not in found:
            found[key] = sum(map(len, rows))
            rows.append(block)
        return found[key]

    for number, slot in enumerate(slots):
        shown = np.zeros((len(slot.pictures), *below[slot.area[0]].shape), np.uint8)
        top, across = slot.area
        changed = slot.pictures.reshape(*slot.pictures.shape[:2], -1)
        if not slot.mixed:
            changed = np.where(owner[slot.area] == number, changed ^ below[slot.area], 0).astype(np.uint8)
        shown[:, :, across] = changed
        for part in range(across.start // length, -(-across.stop // length)):
            inside = slice(part * length, (part + 1) * length)
            block, seen = shown[:, :, inside].copy(), shown[:, :, inside].any((0, 2))
            first = seen & (layers[top, part] == 0)
            block[:, first] ^= below[top, inside][first]
            start = row_number(block.reshape(-1, length))
            for line in np.flatnonzero(seen).tolist():
                y = slot.y + line
                entries.append((layers[y, part], y, part, number, start + line, block.shape[1]))
                layers[y, part] += 1
    for y, part in np.argwhere(layers == 0).tolist():
        inside = slice(part * length, (part + 1) * length)
        entries.append((0, y, part, 0, row_number(below[y : y + 1, inside]), 0))
    nothing = row_number(np.zeros((1, length), np.uint8))
    tables = np.zeros((3, max(1, layers.max()), size, parts), np.uint32)
    tables[1] = nothing
    for layer, y, part, number, start, stride in entries:
        tables[:, layer, y, part] = number, start, stride
    return _Plan(np.concatenate(rows), *tables)


@jax.custom_batching.custom_vmap
def apart(codes: Array) -> Array:
    """The same codes, worked out once, and not anew for every byte that shows them."""
    return codes


@apart.def_vmap
def _apart_in_a_batch(size: int, batched: list[bool], codes: Array) -> tuple[Array, bool]:
    """The compiler for the CPU drops optimization barriers, but cannot look through a condition it does not know.

    Other devices honour the barrier, and there a condition would make the host wait.
    """

    def on_cpu(codes: Array) -> Array:
        unknown = codes.reshape(-1)[0] >= 0  # always true
        known: Array = jax.lax.cond(unknown, lambda: codes, lambda: jnp.zeros_like(codes))
        return known

    out: Array = jax.lax.platform_dependent(codes, cpu=on_cpu, default=jax.lax.optimization_barrier)
    return out, True


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
