"""Scripted players of BattleShip: one knows the ships, one infers them from the marks it has
seen.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.battleship.renderer import HIT, KINDS
from arcade_torch.envs_jax.battleship.rules import SHIPS
from arcade_torch.envs_jax.boards import towards
from arcade_torch.envs_jax.oracles import Actions, Bools, Frames, FramesPlayer

Board = npt.NDArray[Any]
UNKNOWN = -1
WATER = 0
SHIP = 1


def distances(x: Board, y: Board, side: int) -> npt.NDArray[np.int64]:
    """Moves from each cursor to every cell: int64 [N, column, row]."""
    cell = np.arange(side)
    away: npt.NDArray[np.int64] = np.abs(cell[:, None] - x[:, None, None]) + np.abs(
        cell - y[:, None, None]
    )
    return away


class StateOracle:
    """Sees the ships: goes to the nearest ship cell that is not hit yet and fires. The return is
    always 1.
    """

    def __init__(self, game: Any) -> None:
        self.side = game.level.side

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        left = (seen.board == 1) & (seen.guesses == 0)
        cost = np.where(left, distances(seen.x, seen.y, self.side), 4 * self.side)
        goal = cost.reshape(len(is_init), -1).argmin(1)
        return towards(seen.x, seen.y, goal // self.side, goal % self.side)


class FramesOracle(FramesPlayer):
    """Sees the POMDP's frames: remembers every mark and fires where a ship is likely and near.

    The score of a cell counts the straight places of every ship that hold the cell and no known
    water; places that hold known hits count more. The next shot goes to the cell with the highest
    score for its squared distance. In a few episodes the time runs out before the last ship is
    found.

    Args:
        game: The BattleShip to play.
        boost: How much more a place counts for each hit it holds.
    """

    def __init__(self, game: Any, boost: float = 4.0) -> None:
        super().__init__(game)
        self.boost = boost

    def allocate(self, num_envs: int) -> None:
        """See :meth:`FramesPlayer.allocate`."""
        side = self.level.side
        self.marks = np.full((num_envs, side, side), UNKNOWN)

    def choose(self, frames: Frames, is_init: Bools) -> Actions:
        """See :meth:`FramesPlayer.choose`."""
        side = self.level.side
        envs = np.arange(len(frames))
        self.marks[is_init] = UNKNOWN
        codes = self.screen.board.read(frames, side, side).swapaxes(1, 2)  # [N, column, row]
        cursor = (codes >= KINDS).reshape(len(frames), -1).argmax(1)
        x = cursor // side
        y = cursor % side
        mark = codes[envs, x, y] - KINDS
        self.marks[envs, x, y] = np.where(mark == 0, self.marks[envs, x, y], mark == HIT)

        value = ship_scores(self.marks, self.boost) / (1 + distances(x, y, side)) ** 2
        goal = np.where(self.marks == UNKNOWN, value, -1).reshape(len(frames), -1).argmax(1)
        return towards(x, y, goal // side, goal % side)


def ship_scores(marks: npt.NDArray[np.int64], boost: float) -> npt.NDArray[np.float64]:
    """How well ships fit onto each cell of boards of ``UNKNOWN``, ``WATER`` and ``SHIP``: float64
    [N, side, side].

    A known ship cell multiplies the weight of a place by ``boost``.
    """
    score = np.zeros(marks.shape)
    for turned in (False, True):
        board = marks.swapaxes(1, 2) if turned else marks
        total = score.swapaxes(1, 2) if turned else score
        side = board.shape[1]
        for length in SHIPS:
            starts = side - length + 1
            lines = np.stack([board[:, k : k + starts] for k in range(length)])
            weight = np.where((lines == WATER).any(0), 0.0, boost ** (lines == SHIP).sum(0))
            for k in range(length):
                total[:, k : k + starts] += weight
    return score
