"""Scripted players of Signpost: one is told the sign, one reads it off the first frame and
remembers it.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import RIGHT
from arcade_torch.envs_jax.signpost.renderer import KINDS

Actions = npt.NDArray[np.int32]


class StateOracle:
    """Sees the sign: always opens the gate, return 1."""

    def __init__(self, game: Any) -> None:
        self.gate = game.level.corridor

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> Actions:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        return np.where(seen.x == self.gate, seen.sign, RIGHT).astype(np.int32)


class FramesOracle:
    """Sees the POMDP's frames: the sign stands on the first of them alone; return 1."""

    def __init__(self, game: Any) -> None:
        self.screen = game.screen
        self.gate = game.level.corridor
        self.sign: npt.NDArray[np.int64] = np.zeros(0, np.int64)

    def act(self, seen: npt.NDArray[np.uint8], is_init: npt.NDArray[np.bool_]) -> Actions:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        if len(self.sign) != len(seen):
            self.sign = np.zeros(len(seen), np.int64)
        shown = self.screen.sign.read(seen)
        self.sign = np.where(is_init, shown, self.sign)
        walker = (self.screen.corridor.read(seen, 1, self.gate + 1)[:, 0] >= KINDS).argmax(1)
        return np.where(walker == self.gate, self.sign, RIGHT).astype(np.int32)
