"""Drawing for games: host-side primitives, text, and the atlas renderer. Users may build games of
their own with it.
"""

from arcade_torch.envs_jax.render.canvas import (
    arc,
    bitmap,
    blank,
    disc,
    paint,
    pixel_centres,
    polygon,
    rectangle,
)
from arcade_torch.envs_jax.render.screen import (
    GRID_LINE,
    GridLayout,
    Layers,
    Slot,
    TileGrid,
    grid_layout,
    lined_board,
    number_slot,
    titled_background,
)
from arcade_torch.envs_jax.render.text import (
    DIGITS,
    LETTERS,
    PATTERN,
    TEXT,
    centred,
    draw_name,
    number_pictures,
)

__all__ = [
    "DIGITS",
    "GRID_LINE",
    "LETTERS",
    "PATTERN",
    "TEXT",
    "GridLayout",
    "Layers",
    "Slot",
    "TileGrid",
    "arc",
    "bitmap",
    "blank",
    "centred",
    "disc",
    "draw_name",
    "grid_layout",
    "lined_board",
    "number_pictures",
    "number_slot",
    "paint",
    "pixel_centres",
    "polygon",
    "rectangle",
    "titled_background",
]
