"""The screen of CartPole: a cart, an analytic pole, and two arrows from an atlas."""

import math
from typing import Literal

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.cartpole.rules import THETA_LIMIT, X_LIMIT, CartPoleState
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import (
    Layers,
    Slot,
    TileGrid,
    arc,
    blank,
    number_slot,
    polygon,
    rectangle,
    titled_background,
)
from arcade_torch.envs_jax.render.canvas import Picture
from arcade_torch.envs_jax.render.palette import (
    CHARCOAL,
    COPPER,
    PINK,
    SILVER,
    SKY,
    SPRING_GREEN,
    Colour,
)

Arrow = Literal["log", "linear"]
ARROWS: tuple[Arrow, ...] = ("log", "linear")

LOG_CLASSES = 6  # 2 ln(1 + |v|) truncated: 0 to 3 for |v| < 6.4, two more to spare
LINEAR_TOP = 4.0  # velocity (m/s or rad/s) at which a linear arrow fills its box


class Geometry:
    """Lengths in pixels on a screen of one size; all that scales is given for 128 pixels."""

    def __init__(self, size: int) -> None:
        unit = size // 128
        self.size = size
        self.offset = 16 * unit  # of the field within the screen
        self.field = 96 * unit  # side of the field
        self.cart = (32 * unit, 16 * unit)  # width and height
        self.cart_top = 48 * unit
        self.cart_range = self.field - self.cart[0]  # the cart's left edge goes from 0 to here
        self.pole_length = 32 * unit
        self.pole_radius = {128: 3, 256: 5}[size]
        self.box = 22 * unit  # side of an arrow's box
        # (x, y) of the two arrows' boxes
        self.boxes = ((5 * unit, 69 * unit), (69 * unit, 69 * unit))
        self.head = {128: 6, 256: 8}[size]  # length of the smallest arrow head
        self.pivot_y = self.cart_top + self.cart[1] // 2
        self.strip = (
            self.pivot_y - self.pole_length - self.pole_radius,
            self.cart_top + self.cart[1],
        )


def thickness_of(level: int) -> int:
    """Thickness of a logarithmic arrow's shaft: 2 plus its class, rounded down to even."""
    return (2 + level) // 2 * 2


def _flat_arrow(geo: Geometry, length: int, head: int, thickness: int, right: bool) -> Picture:
    """A horizontal arrow ``length`` px long from one side of its box, with a triangular head of
    ``head`` px.
    """
    box = geo.box
    middle = geo.box // 2
    picture = blank(box, box, CHARCOAL)
    # what is shorter than a head is a bare shaft
    base = length - head if length >= head else length
    rectangle(picture, 0, middle - thickness // 2, base, middle + thickness // 2, SILVER)
    if base < length:
        polygon(
            picture,
            [(base, middle - head / 2), (length, middle), (base, middle + head / 2)],
            SILVER,
        )
    return picture if right else picture[:, ::-1]


def _bent_arrow(geo: Geometry, share: float, head: int, thickness: int, clockwise: bool) -> Picture:
    """A quarter ring in the upper right of its box, ``share`` of it drawn, with the head at its
    leading end.

    Drawn clockwise, from the top to the right; the other way round is its mirror image in the
    diagonal.
    """
    centre = outer = geo.box / 2
    picture = blank(geo.box, geo.box, CHARCOAL)
    ring = outer - thickness / 2
    start = math.pi / 2
    tip = math.pi / 2 * (1 - share)
    # what is shorter than a head is a bare ring
    base = tip + head / ring if tip + head / ring <= start else tip
    arc(picture, centre, centre, outer - thickness, outer, base, start, SILVER)
    if base > tip:
        corners = [(base, ring - head / 2), (base, min(ring + head / 2, outer)), (tip, ring)]
        polygon(
            picture,
            [(centre + r * math.cos(a), centre - r * math.sin(a)) for a, r in corners],
            SILVER,
        )
    return picture if clockwise else picture.transpose(1, 0, 2)[::-1, ::-1]


def arrow_pictures(geo: Geometry, arrow: Arrow) -> tuple[Picture, Picture]:
    """Both arrows for every code: first all that point left (or turn counter-clockwise), then
    right.

    Returns:
        The flat and the bent arrow, uint8 [2 * levels, box, box, 3].
    """
    flat = []
    bent = []
    for forward in (False, True):
        for level in range(arrow_levels(geo, arrow)):
            if arrow == "log":
                head = geo.head + level
                thickness = thickness_of(level)
                flat.append(_flat_arrow(geo, geo.box, head, thickness, forward))
                bent.append(_bent_arrow(geo, 1.0, head, thickness, forward))
            else:  # the length says it all; a broad ring tells every angle apart
                flat.append(_flat_arrow(geo, level, geo.head, 2, forward))
                bent.append(_bent_arrow(geo, level / geo.box, geo.head, geo.box // 4, forward))
    return np.stack(flat), np.stack(bent)


def arrow_levels(geo: Geometry, arrow: Arrow) -> int:
    """How many lengths an arrow can have in each direction."""
    return LOG_CLASSES if arrow == "log" else geo.box + 1


def arrow_level(speed: Array, arrow: Arrow, box: int) -> Array:
    """Which of its lengths the arrow of a speed (float, m/s or rad/s, not negative) has: int32."""
    if arrow == "log":
        return jnp.minimum(jnp.trunc(2.0 * jnp.log1p(speed)).astype(jnp.int32), LOG_CLASSES - 1)
    return jnp.round(box * jnp.minimum(speed, LINEAR_TOP) / LINEAR_TOP).astype(jnp.int32)


def pole_span(geo: Geometry, pivot_x: Array, theta: Array, rows: Array) -> tuple[Array, Array]:
    """First and last column that the pole covers in each row.

    The pole is a segment with round ends, the convex hull of two discs. In any row it is therefore
    one interval, bounded by an arc of either disc or by the tangent between them.

    Args:
        geo: Lengths.
        pivot_x: Column of its lower end.
        theta: Angle, rad, positive to the right, |theta| < pi / 2.
        rows: int [R], rows of the field.

    Returns:
        float32 [R] twice; where the pole covers nothing the first exceeds the last.
    """
    radius = float(geo.pole_radius)
    sin = jnp.sin(theta)
    cos = jnp.cos(theta)
    y = rows.astype(jnp.float32)
    low = jnp.full(rows.shape, jnp.inf)
    high = jnp.full(rows.shape, -jnp.inf)
    for along in (0.0, float(geo.pole_length)):
        height = radius**2 - (y - (geo.pivot_y - along * cos)) ** 2
        reach = jnp.where(height >= 0, jnp.sqrt(jnp.maximum(height, 0.0)), -jnp.inf)
        low = jnp.minimum(low, pivot_x + along * sin - reach)
        high = jnp.maximum(high, pivot_x + along * sin + reach)
    for side in (-1.0, 1.0):
        from_y = geo.pivot_y + side * radius * sin  # lower end of the tangent on this side
        rise = from_y - y
        edge = pivot_x + side * radius * cos + rise * jnp.tan(theta)
        between = (rise >= 0) & (rise <= geo.pole_length * cos)
        low = jnp.where(between, jnp.minimum(low, edge), low)
        high = jnp.where(between, jnp.maximum(high, edge), high)
    return low, high


class Screen:
    """Everything on the screen of one CartPole configuration.

    Args:
        size: Side of the picture, 128 or 256.
        max_score: Highest number shown.
        arrow: How arrows tell a velocity.
    """

    def __init__(self, size: int, max_score: int, arrow: Arrow) -> None:
        self.geo = geo = Geometry(size)
        self.arrow: Arrow = arrow
        background = titled_background(size, "CARTPOLE", CHARCOAL, SKY)
        self.score = number_slot(size, max_score, CHARCOAL, SPRING_GREEN)
        self.arrows = [
            Slot(pictures, geo.offset + x, geo.offset + y)
            for pictures, (x, y) in zip(arrow_pictures(geo, arrow), geo.boxes, strict=True)
        ]
        self.layers = Layers(background, self.score, *self.arrows, *self._cart_and_pole())

    def _cart_and_pole(self) -> list[TileGrid]:
        """The cart, and both ends of the pole, above the cart and upon it: a code for every line of
        the field.

        Codes of the cart are the column where it begins; the last one is for no cart. Codes of an
        end are the column from which on colours change, so that two ends leave the pole between
        them.
        """
        geo = self.geo
        columns = np.arange(geo.field)
        starts = np.arange(geo.cart_range + 2)[:, None]
        cart = (columns >= starts) & (columns < starts + geo.cart[0]) & (starts <= geo.cart_range)
        end = columns >= np.arange(geo.field + 1)[:, None]

        def lines(y: int, mask: npt.NDArray[np.bool_], below: Colour, colour: Colour) -> TileGrid:
            change = np.bitwise_xor(below, colour).astype(np.uint8)
            return TileGrid(mask[:, None, :, None] * change, geo.offset, geo.offset + y, mixed=True)

        above = lines(geo.strip[0], end, CHARCOAL, COPPER)
        upon = lines(geo.cart_top, end, PINK, COPPER)
        return [lines(geo.cart_top, cart, CHARCOAL, PINK), above, above, upon, upon]

    def draw(self, state: CartPoleState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. From step 1 on, the POMDP twin shows arrows and
        score alone.
        """
        geo = self.geo
        seen = jnp.stack([state.x, state.x_dot, state.theta, state.theta_dot]) + state.noise
        hidden = jnp.asarray(partial) & (state.time > 0)
        arrows = []
        for slot, velocity in zip(self.arrows, (seen[1], seen[3]), strict=True):
            levels = len(slot.pictures) // 2
            arrows.append(
                arrow_level(jnp.abs(velocity), self.arrow, geo.box)
                + jnp.where(velocity > 0, levels, 0)
            )

        x = jnp.clip(seen[0], -X_LIMIT, X_LIMIT)
        theta = jnp.clip(seen[2], -THETA_LIMIT, THETA_LIMIT)
        left = jnp.trunc((x / X_LIMIT + 1) * (geo.cart_range / 2))
        low, high = pole_span(geo, left + geo.cart[0] // 2, theta, jnp.arange(*geo.strip))
        low = jnp.ceil(jnp.clip(low, 0, geo.field))
        high = jnp.where(
            hidden, low, jnp.maximum(low, jnp.floor(jnp.clip(high, -1, geo.field - 1)) + 1)
        )
        cart = jnp.full((geo.cart[1], 1), jnp.where(hidden, geo.cart_range + 1, left))
        ends = jnp.stack([low, high])[:, :, None]
        above = geo.cart_top - geo.strip[0]
        return self.layers.draw(state.score, *arrows, cart, *ends[:, :above], *ends[:, above:])
