"""Pictures of card suits, stretched to any box; heart and diamond are red, spade and club black."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.cards import CLUB, DIAMOND, HEART, SPADE
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render.canvas import Mask, Picture, blank, paint
from arcade_torch.envs_jax.render.palette import BLACK, RED, Colour
from arcade_torch.envs_jax.render.screen import Slot, TileGrid
from arcade_torch.envs_jax.render.text import centred

SUIT_COLOURS: dict[int, Colour] = {HEART: RED, SPADE: BLACK, CLUB: BLACK, DIAMOND: RED}
NO_CARD = 0  # code of the empty picture; suit s has code 1 + s

_FINE = 16  # points per pixel and direction at which a shape is asked for
Plane = npt.NDArray[np.floating]


def _ellipse(x: Plane, y: Plane, cx: float, cy: float, rx: float, ry: float) -> Mask:
    mask: Mask = ((x - cx) / rx) ** 2 + ((y - cy) / ry) ** 2 <= 1
    return mask


def _heart(x: Plane, y: Plane) -> Mask:
    """Two lobes with a notch between them that survives in small boxes, over a point."""
    lobes = _ellipse(np.abs(x), y, 0.52, -0.45, 0.48, 0.55)
    point = (y >= -0.4) & (np.abs(x) <= 1 - np.maximum((y + 0.4) / 1.4, 0) ** 1.3)
    mask: Mask = lobes | point
    return mask


def _foot(x: Plane, y: Plane) -> Mask:
    """A stem on a broad foot."""
    stem = (np.abs(x) <= 0.15) & (y >= -0.3)
    mask: Mask = stem | (
        (y >= 0.4) & (np.abs(x) <= 0.15 + 0.4 * np.maximum((y - 0.4) / 0.6, 0) ** 3)
    )
    return mask


def _spade(x: Plane, y: Plane) -> Mask:
    return _heart(x, 1 - (y + 1) * 1.25) | _foot(x, y)


def _club(x: Plane, y: Plane) -> Mask:
    top = _ellipse(x, y, 0, -0.58, 0.42, 0.42)
    return top | _ellipse(np.abs(x), y, 0.6, 0.2, 0.4, 0.36) | _foot(x, y)


def _diamond(x: Plane, y: Plane) -> Mask:
    mask: Mask = np.abs(x) + np.abs(y) <= 1
    return mask


_SHAPES: dict[int, Callable[[Plane, Plane], Mask]] = {
    HEART: _heart,
    SPADE: _spade,
    CLUB: _club,
    DIAMOND: _diamond,
}


def suit_mask(suit: int, height: int, width: int) -> Mask:
    """The pixels at least half covered by a suit's symbol stretched to a box: bool [height,
    width].
    """
    x = (np.arange(width * _FINE) + 0.5) / (width * _FINE) * 2 - 1
    y = (np.arange(height * _FINE) + 0.5) / (height * _FINE) * 2 - 1
    inside = _SHAPES[suit](x[None, :], y[:, None])
    covered = inside.reshape(height, _FINE, width, _FINE).mean((1, 3))
    mask: Mask = covered >= 0.5
    return mask


def suit_pictures(
    side: tuple[int, int], box: tuple[int, int], background: Colour, shorter: int = 0
) -> Picture:
    """No card and the four suits, each on its own ground.

    Args:
        side: Height and width of a picture.
        box: Height and width of the symbol, centred in the picture (rounded towards the upper
            left).
        background: Colour behind it.
        shorter: Rows by which the black suits end above the others.

    Returns:
        uint8 [5, height, width, 3], by code: ``NO_CARD``, then 1 + suit.
    """
    top = centred(side[0], box[0])
    left = centred(side[1], box[1])
    pictures = [blank(*side, background)]
    for suit, colour in SUIT_COLOURS.items():
        mask = np.zeros(side, bool)
        height = box[0] - (shorter if colour == BLACK else 0)
        mask[top : top + height, left : left + box[1]] = suit_mask(suit, height, box[1])
        pictures.append(paint(blank(*side, background), mask, colour))
    return np.stack(pictures)


FIELD = (16, 96)  # offset and side of the square that holds the history, for a screen of 128 pixels
ROW = 9  # cards in a row of the history
_PITCH = 10  # distance between its cards, for 128 pixels
_SYMBOL = {128: (9, 8), 256: (18, 12)}  # height and width of its symbols


def corner_slot(size: int, right: bool, background: Colour, shorter: int) -> Slot:
    """The place of one large card in an upper corner of the screen; codes as in
    :func:`suit_pictures`.

    Args:
        size: Side of the screen, 128 or 256.
        right: In the right corner, else in the left.
        background: Colour behind the card.
        shorter: Rows by which the black suits end above the others.
    """
    unit = size // 128
    box = (20 * unit, 10 * unit)
    return Slot(suit_pictures(box, box, background, shorter), 117 * unit if right else 0, 0)


def history_grid(size: int, background: Colour) -> TileGrid:
    """Nine small cards a row, centred across the field; codes as in :func:`suit_pictures`."""
    unit = size // 128
    side = _PITCH * unit
    start = FIELD[0] * unit + centred(FIELD[1] * unit, ROW * side)
    return TileGrid(suit_pictures((side, side), _SYMBOL[size], background), start, start)


def history_codes(cards: Array, visible: Array) -> Array:
    """Lay cards out in rows, left to right and downwards.

    Args:
        cards: int8 [N], suits.
        visible: bool [N], false where the place stays empty.

    Returns:
        Codes for :func:`history_grid`, int8 [rows, 9].
    """
    rows = -(-len(cards) // ROW)
    codes = jnp.where(visible, 1 + cards, NO_CARD)
    return jnp.pad(codes, (0, rows * ROW - len(cards))).reshape(rows, ROW)
