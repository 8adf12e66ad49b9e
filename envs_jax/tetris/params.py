"""The parameters of Tetris."""

from dataclasses import dataclass

import numpy as np

ROWS = 20
COLUMNS = 10
# column and row of a new piece's box
SPAWN_X = 3
SPAWN_Y = 0
GOAL = 10  # lines that win
LINE_REWARD = 0.1  # for each of them
TOP_OUT_REWARD = -1.0
MAX_STEPS = 3000
MAX_AGE = 10  # the counter of steps since the spawn stops here
BOX = 4  # a piece lives in a box of 4 x 4 cells
ROTATIONS = 4

# Cells of each piece in its box, "12" for row 1 and column 2; one group for each rotation,
# clockwise.
_PIECES = {
    "I": "10 11 12 13 | 02 12 22 32 | 20 21 22 23 | 01 11 21 31",
    "O": "11 12 21 22 | 11 12 21 22 | 11 12 21 22 | 11 12 21 22",
    "T": "11 20 21 22 | 11 21 22 31 | 20 21 22 31 | 11 20 21 31",
    "S": "11 12 20 21 | 11 21 22 32 | 21 22 30 31 | 10 20 21 31",
    "Z": "10 11 21 22 | 12 21 22 31 | 20 21 31 32 | 11 20 21 30",
    "J": "10 20 21 22 | 11 12 21 31 | 20 21 22 32 | 11 21 30 31",
    "L": "12 20 21 22 | 11 21 31 32 | 20 21 22 30 | 10 11 21 31",
}
PIECES = len(_PIECES)


def _shapes() -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """The table above as bool [piece, rotation, row, column]."""
    shapes = np.zeros((PIECES, ROTATIONS, BOX, BOX), bool)
    for piece, rotations in enumerate(_PIECES.values()):
        for rotation, cells in enumerate(rotations.split("|")):
            for cell in cells.split():
                shapes[piece, rotation, int(cell[0]), int(cell[1])] = True
    return shapes


SHAPES = _shapes()


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    previews: int  # coming pieces that are shown
    fall: int  # cells a piece falls by itself at every step
    drop: int  # cells it goes down by a soft drop


LEVELS = {
    "TetrisEasy": Params(3, 1, 2),
    "TetrisMedium": Params(2, 1, 2),
    "TetrisHard": Params(1, 2, 3),
}
