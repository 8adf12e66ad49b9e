"""Scripted players of Signpost: one is told the sign, one reads it off the first frame and
remembers it.
"""

from typing import Any

import numpy as np

from arcade_torch.envs_jax.game import RIGHT
from arcade_torch.envs_jax.oracles import Actions, Bools, Frames, FramesPlayer
from arcade_torch.envs_jax.signpost.renderer import KINDS


class StateOracle:
    """Sees the sign: always opens the gate, return 1."""

    def __init__(self, game: Any) -> None:
        self.gate = game.level.corridor

    def act(self, seen: Any, is_init: Bools) -> Actions:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        return np.where(seen.x == self.gate, seen.sign, RIGHT).astype(np.int32)


class FramesOracle(FramesPlayer):
    """Sees the POMDP's frames: the sign stands on the first of them alone; return 1."""

    def allocate(self, num_envs: int) -> None:
        """See :meth:`FramesPlayer.allocate`."""
        self.sign = np.zeros(num_envs, np.int64)

    def choose(self, frames: Frames, is_init: Bools) -> Actions:
        """See :meth:`FramesPlayer.choose`."""
        gate = self.level.corridor
        self.sign = np.where(is_init, self.screen.sign.read(frames), self.sign)
        corridor = self.screen.corridor.read(frames, 1, gate + 1)[:, 0]
        walker = (corridor >= KINDS).argmax(1)
        return np.where(walker == gate, self.sign, RIGHT)
