"""The parameters of Skittles."""

from dataclasses import dataclass

CELLS = 10  # rows and columns of the grid
MAX_STEPS = 100  # time limit; each step pays 1 / MAX_STEPS
COLOURS = 7  # blocks take turns through as many colours


@dataclass(frozen=True)
class Params:
    """One difficulty: the lane, where blocks fall and the agent may stand."""

    width: int  # columns of the lane
    first: int  # its leftmost column

    @property
    def last(self) -> int:
        """Rightmost column of the lane."""
        return self.first + self.width - 1


LEVELS = {
    "SkittlesEasy": Params(8, 1),
    "SkittlesMedium": Params(7, 2),
    "SkittlesHard": Params(6, 2),
}
