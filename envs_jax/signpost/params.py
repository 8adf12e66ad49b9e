"""The parameters of Signpost."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Params:
    """One difficulty."""

    corridor: int  # cells to walk before the gate; the sign has to be remembered for as many steps

    @property
    def cells(self) -> int:
        """Cells of the corridor and the gate."""
        return self.corridor + 1

    @property
    def max_steps(self) -> int:
        """Steps of every episode: the walk and the answer."""
        return self.cells


LEVELS = {"SignpostEasy": Params(4), "SignpostMedium": Params(6), "SignpostHard": Params(9)}
