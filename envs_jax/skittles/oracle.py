"""Scripted players of Skittles: both plan nine steps ahead, one on all blocks, one on those it has
ever seen.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import LEFT, RIGHT, UP
from arcade_torch.envs_jax.oracles import Actions, Bools, Frames, FramesPlayer
from arcade_torch.envs_jax.skittles.renderer import AGENT
from arcade_torch.envs_jax.skittles.rules import CELLS, NO_BLOCK, Params

UNSEEN = -2  # a block is in this row, nobody knows where
MOVES = np.array([LEFT, UP, RIGHT], np.int32)


def beside(values: npt.NDArray[Any], fill: Any) -> npt.NDArray[Any]:
    """Values [..., width] in the column to the left, in the same and in that to the right: [3, ...,
    width].
    """
    padded = np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 1)], constant_values=fill)
    return np.stack([padded[..., :-2], values, padded[..., 2:]])


def outlook(width: int, rounds: int = 5) -> npt.NDArray[np.float64]:
    """What it is worth to have a choice of columns when the newest row arrives.

    Args:
        width: Columns of the lane.
        rounds: Blocks to look ahead.

    Returns:
        float64 [2**width, width + 1]: for a set of columns (column ``c`` is bit ``c``) and the
        newest block's column (``width`` for none), the chance that ``rounds`` random blocks leave a
        way through from some column of the set.
    """
    bits = 1 << np.arange(width)
    sets = (np.arange(2**width)[:, None] & bits) > 0
    moved: npt.NDArray[np.bool_] = np.any(beside(sets, False), axis=0)
    worth = np.repeat(sets.any(1)[:, None], width + 1, 1).astype(float)
    for _ in range(rounds):
        # After a block at `newest` leaves and one at `block` arrives: [set, newest, block, column].
        free = np.arange(width) != np.arange(width + 1)[:, None]
        left = moved[:, None, None] & free[:, None] & free[:width]
        worth = worth[left @ bits, np.arange(width)].mean(-1)
    return worth


class Planner:
    """Chooses moves with a known or a partly known grid."""

    def __init__(self, level: Params) -> None:
        self.level = level
        self.worth = outlook(level.width)

    def plan(self, x: npt.NDArray[Any], column: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
        """The move with the best chance to live, and then with the best choice of columns.

        Args:
            x: int [N], the agent's column.
            column: int [N, CELLS], the block's column in each row, ``NO_BLOCK`` or ``UNSEEN``.

        Returns:
            int32 [N]: ``LEFT``, ``RIGHT``, or ``UP`` to wait.
        """
        width = self.level.width
        lane = self.level.first + np.arange(width)
        block = column[..., None] == lane  # [N, rows, width]
        clear = 1.0 - np.where(column[..., None] == UNSEEN, 1 / width, block)
        reached = np.clip(x[:, None] + np.array([-1, 0, 1]), lane[0], lane[-1])
        ways = reached[..., None] == lane  # [N, moves, width], the columns each first move leads to
        alive = ways.astype(float)  # the best chance to be there alive
        # the block of this row leaves, that of the row above arrives
        for row in range(CELLS - 1, 0, -1):
            if row < CELLS - 1:
                ways = beside(ways, False).any(0)
                alive = beside(alive, 0.0).max(0)
            ways = ways & ~(block[:, row] | block[:, row - 1])[:, None]
            alive = alive * (clear[:, row] * clear[:, row - 1])[:, None]
        newest = np.where(column[:, 0] < 0, width, column[:, 0] - self.level.first)
        score = alive.max(-1) * self.worth[ways @ (1 << np.arange(width)), newest[:, None]]
        score[:, 1] += 1e-9  # wait where nothing is gained
        moves: npt.NDArray[np.int32] = MOVES[score.argmax(1)]
        return moves


class StateOracle:
    """Sees all blocks."""

    def __init__(self, game: Any) -> None:
        self.planner = Planner(game.level)

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        return self.planner.plan(seen.x, seen.column)


class FramesOracle(FramesPlayer):
    """Sees the POMDP's frames: every block seen once is remembered while it falls.

    A block has nine looks before it can hit; the one in 512 that is never seen is what the player
    cannot avoid but by luck.
    """

    def __init__(self, game: Any) -> None:
        super().__init__(game)
        self.planner = Planner(game.level)

    def allocate(self, num_envs: int) -> None:
        """See :meth:`FramesPlayer.allocate`."""
        self.column = np.full((num_envs, CELLS), NO_BLOCK)

    def choose(self, frames: Frames, is_init: Bools) -> Actions:
        """See :meth:`FramesPlayer.choose`."""
        fallen = np.pad(self.column[:, :-1], ((0, 0), (1, 0)), constant_values=UNSEEN)
        self.column = np.where(is_init[:, None], NO_BLOCK, fallen)
        codes = self.screen.board.read(frames, CELLS, CELLS)
        block = (codes > 0) & (codes < AGENT)
        self.column = np.where(block.any(-1), block.argmax(-1), self.column)
        return self.planner.plan((codes[:, -1] == AGENT).argmax(-1), self.column)
