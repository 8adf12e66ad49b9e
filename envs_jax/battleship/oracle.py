"""Scripted players of BattleShip: one knows the ships, one infers them from the marks it has
seen.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.battleship.renderer import HIT, KINDS
from arcade_torch.envs_jax.battleship.rules import SHIPS
from arcade_torch.envs_jax.boards import towards

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


class FramesOracle:
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
        self.screen = game.screen
        self.side = game.level.side
        self.boost = boost
        self.known: npt.NDArray[np.int64] = np.zeros((0, 0, 0), np.int64)

    def act(
        self, seen: npt.NDArray[np.uint8], is_init: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        side = self.side
        envs = np.arange(len(seen))
        if len(self.known) != len(seen):
            self.known = np.full((len(seen), side, side), UNKNOWN)
        self.known[is_init] = UNKNOWN
        codes = self.screen.board.read(seen, side, side).swapaxes(1, 2)  # [N, column, row]
        cursor = (codes >= KINDS).reshape(len(seen), -1).argmax(1)
        x = cursor // side
        y = cursor % side
        mark = codes[envs, x, y] - KINDS
        self.known[envs, x, y] = np.where(mark == 0, self.known[envs, x, y], mark == HIT)

        value = ship_scores(self.known, self.boost) / (1 + distances(x, y, side)) ** 2
        goal = np.where(self.known == UNKNOWN, value, -1).reshape(len(seen), -1).argmax(1)
        return towards(x, y, goal // side, goal % side)


def ship_scores(known: npt.NDArray[np.int64], boost: float) -> npt.NDArray[np.float64]:
    """How well ships fit onto each cell of boards of ``UNKNOWN``, ``WATER`` and ``SHIP``: float64
    [N, side, side].

    A known ship cell multiplies the weight of a place by ``boost``.
    """
    score = np.zeros(known.shape)
    for turned in (False, True):
        board = known.swapaxes(1, 2) if turned else known
        total = score.swapaxes(1, 2) if turned else score
        side = board.shape[1]
        for length in SHIPS:
            starts = side - length + 1
            lines = np.stack([board[:, k : k + starts] for k in range(length)])
            weight = np.where((lines == WATER).any(0), 0.0, boost ** (lines == SHIP).sum(0))
            for k in range(length):
                total[:, k : k + starts] += weight
    return score
