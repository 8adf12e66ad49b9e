"""The parameters of BattleShip."""

from dataclasses import dataclass

SHIPS = (2, 3, 3, 4)  # lengths, in the order of placement
SHIP_CELLS = sum(SHIPS)  # hitting one pays 1 / SHIP_CELLS


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    side: int  # cells per side of the sea

    @property
    def cells(self) -> int:
        """Cells of the sea."""
        return self.side**2

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return 2 * self.cells

    @property
    def max_repeats(self) -> int:
        """Shots at cells shot at before that end the game; each pays ``-2 / cells``."""
        return self.cells // 2


LEVELS = {"BattleShipEasy": Params(8), "BattleShipMedium": Params(10), "BattleShipHard": Params(12)}
