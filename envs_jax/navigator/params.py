"""The parameters of Navigator."""

from dataclasses import dataclass

TNTS = 7  # blocks on every map
DEATH_REWARD = -0.5
TREASURE_REWARD = 1.0


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    side: int  # cells per side of the map
    usual_place: tuple[int, int]
    """Places in the list of free cells (x-major) from which the reference takes the treasure's x
    and y in every episode. They are inferred from the measured distribution of its treasures.
    """

    @property
    def cells(self) -> int:
        """Cells of the map."""
        return self.side**2

    @property
    def max_steps(self) -> int:
        """Time limit in steps."""
        return self.cells

    @property
    def step_reward(self) -> float:
        """Reward of a step that neither opens the treasure nor ends on TNT."""
        return -0.5 / self.cells


LEVELS = {
    "NavigatorEasy": Params(8, (18, 38)),
    "NavigatorMedium": Params(10, (45, 56)),
    "NavigatorHard": Params(12, (112, 79)),
}
