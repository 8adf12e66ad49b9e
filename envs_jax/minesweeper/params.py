"""The parameters of MineSweeper."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    side: int  # cells per side of the board
    mines: int  # mines on the board

    @property
    def cells(self) -> int:
        """Cells of the board."""
        return self.side**2

    @property
    def safe(self) -> int:
        """Cells without a mine; sweeping one pays ``1 / safe``."""
        return self.cells - self.mines

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return 2 * self.cells

    @property
    def max_repeats(self) -> int:
        """Sweeps of swept cells that end the game; each pays ``-2 / cells``."""
        return self.cells // 2


LEVELS = {
    "MineSweeperEasy": Params(4, 2),
    "MineSweeperMedium": Params(6, 6),
    "MineSweeperHard": Params(8, 10),
}
