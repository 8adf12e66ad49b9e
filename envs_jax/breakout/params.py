"""The parameters of Breakout."""

from dataclasses import dataclass

ROWS = 20
COLUMNS = 10
WALL_TOP = 1  # row of the uppermost bricks
WALL_ROWS = 6
BRICKS = WALL_ROWS * COLUMNS
PADDLE_ROW = ROWS - 1
START_ROW = 13  # of the ball
START_COLUMN = 5  # of the paddle's left end, where that leaves all of it on the board
MAX_STEPS = 2000

_WEIGHTS = (15, 13, 11, 9, 7, 5)
# by row; all bricks sum to 1
BRICK_REWARD = tuple(weight / (sum(_WEIGHTS) * COLUMNS) for weight in _WEIGHTS)


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    paddle: int  # width of the paddle in columns

    @property
    def right(self) -> int:
        """Rightmost column the paddle's left end can be in."""
        return COLUMNS - self.paddle


LEVELS = {"BreakoutEasy": Params(6), "BreakoutMedium": Params(5), "BreakoutHard": Params(4)}
