"""Drawing primitives on the host: they paint numpy pictures once, before anything is compiled.

A picture is uint8 [height, width, 3]. Points are (x, y), x to the right and y downwards; upper
bounds are exclusive. Shapes are given by masks, so every primitive overwrites and none blends.
"""

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.render.palette import Colour

Picture = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


def blank(height: int, width: int, colour: Colour) -> Picture:
    """A picture of one colour: uint8 [height, width, 3]."""
    return np.broadcast_to(np.array(colour, np.uint8), (height, width, 3)).copy()


def pixel_centres(picture: Picture) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]:
    """Coordinates (x, y) of the pixel centres, float64 [1, width] and [height, 1]."""
    height, width = picture.shape[:2]
    return np.arange(width)[None, :] + 0.5, np.arange(height)[:, None] + 0.5


def paint(picture: Picture, mask: Mask, colour: Colour) -> Picture:
    """Overwrite the pixels of ``mask`` (bool [height, width]) in place; returns the picture."""
    picture[np.broadcast_to(mask, picture.shape[:2])] = colour
    return picture


def rectangle(picture: Picture, x0: int, y0: int, x1: int, y1: int, colour: Colour) -> Picture:
    """Fill columns ``x0 <= x < x1`` of rows ``y0 <= y < y1`` in place; returns the picture."""
    picture[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = colour
    return picture


def disc(picture: Picture, x: float, y: float, radius: float, colour: Colour) -> Picture:
    """Fill the pixels whose centre lies within ``radius`` of (x, y) in place; returns the
    picture.
    """
    px, py = pixel_centres(picture)
    return paint(picture, (px - x) ** 2 + (py - y) ** 2 <= radius**2, colour)


def polygon(picture: Picture, points: list[tuple[float, float]], colour: Colour) -> Picture:
    """Fill a convex polygon in place; returns the picture.

    Args:
        picture: What to draw on.
        points: Corners (x, y) in order, either way round.
        colour: Its colour.
    """
    px, py = pixel_centres(picture)
    sides = []
    for (xa, ya), (xb, yb) in zip(points, points[1:] + points[:1], strict=True):
        sides.append((xb - xa) * (py - ya) - (yb - ya) * (px - xa))
    inside = np.stack(sides)
    return paint(picture, (inside.min(0) >= 0) | (inside.max(0) <= 0), colour)


def arc(
    picture: Picture,
    x: float,
    y: float,
    inner: float,
    outer: float,
    start: float,
    stop: float,
    colour: Colour,
) -> Picture:
    """Fill a piece of a ring in place; returns the picture.

    Args:
        picture: What to draw on.
        x: Centre, to the right.
        y: Centre, downwards.
        inner: Inner radius in pixels.
        outer: Outer radius in pixels.
        start: First angle in radians, counter-clockwise from the right as seen on the screen.
        stop: Last angle in radians, at most one turn after ``start``.
        colour: Its colour.
    """
    px, py = pixel_centres(picture)
    dx = px - x
    dy = y - py
    radius2 = dx**2 + dy**2
    angle = np.mod(np.arctan2(dy, dx) - start, 2 * np.pi)
    return paint(
        picture, (radius2 >= inner**2) & (radius2 <= outer**2) & (angle <= stop - start), colour
    )


def bitmap(
    picture: Picture, rows: tuple[str, ...], x: int, y: int, width: int, height: int, colour: Colour
) -> Picture:
    """Enlarge a pattern of ``"0"`` and ``"1"`` onto the picture in place; returns the picture.

    Args:
        picture: What to draw on.
        rows: The pattern, top row first.
        x: Left edge.
        y: Top edge.
        width: Pixels per pattern column.
        height: Pixels per pattern row.
        colour: Colour of the ones; zeros leave the picture as it is.
    """
    pattern = np.array([[bit == "1" for bit in row] for row in rows])
    big = pattern.repeat(height, 0).repeat(width, 1)
    paint(picture[y : y + big.shape[0], x : x + big.shape[1]], big, colour)
    return picture
