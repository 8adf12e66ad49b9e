"""Names above pictures: which twin of a game is which."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.render.canvas import bitmap, blank
from arcade_torch.envs_jax.render.text import LETTERS, PATTERN

PAPER = 255
INK = (40, 40, 40)
TWINS = {False: "MDP", True: "POMDP"}
"""Whether a picture is partial -> what stands above it."""
HEIGHT = 12
"""Of a caption, in cells of its letters; even, as films want it."""


def caption(names: Sequence[str], width: int, cell: int) -> npt.NDArray[np.uint8]:
    """Names in capitals side by side, each in the middle of its share of the width.

    Args:
        names: of letters alone.
        width: of all together, in pixels.
        cell: side of one cell of a letter, in pixels.

    Returns:
        uint8 [12 cell, width, 3].
    """
    picture = blank(HEIGHT * cell, width, (PAPER,) * 3)
    step = (PATTERN + 1) * cell
    share = width // len(names)
    top = (HEIGHT - PATTERN) // 2 * cell
    for place, name in enumerate(names):
        left = place * share + (share - len(name) * step + cell) // 2
        for letter in name:
            bitmap(picture, LETTERS[letter], left, top, cell, cell, INK)
            left += step
    return picture


def captioned(frame: npt.NDArray[np.uint8], twins: Sequence[bool]) -> npt.NDArray[np.uint8]:
    """A frame, or several side by side, under the names of its twins; ``twins`` says which are
    partial.
    """
    height, width = frame.shape[:2]
    names = [TWINS[partial] for partial in twins]
    return np.concatenate([caption(names, width, max(1, height // 128)), frame])
