"""Scripted players of MineSweeper: one walks a known board, one infers it from the numbers it has
seen.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.boards import towards
from arcade_torch.envs_jax.minesweeper.renderer import KINDS
from arcade_torch.envs_jax.minesweeper.rules import COVERED_SAFE
from arcade_torch.envs_jax.oracles import Actions, Bools, Frames, FramesPlayer

Board = npt.NDArray[Any]


def snake(side: int) -> npt.NDArray[np.int64]:
    """A walk over the whole board from the top left, row by row in turns: (x, y), int64 [side**2,
    2].
    """
    return np.array(
        [(x if y % 2 == 0 else side - 1 - x, y) for y in range(side) for x in range(side)]
    )


class StateOracle:
    """Sees the mines: goes to the nearest corner, then walks the board in turns and sweeps what is
    safe.

    The walk takes at most ``side - 2`` steps to a corner, ``cells - 1`` over the board and ``safe``
    sweeps, which fits in the time limit at every difficulty: the return is always 1.
    """

    def __init__(self, game: Any) -> None:
        self.side = game.level.side
        walk = snake(self.side)
        flips = np.array(list(np.ndindex(2, 2)))[:, None]  # four walks, one from each corner
        self.walks = np.where(flips, self.side - 1 - walk, walk)
        self.walk = np.zeros(0, np.int64)

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        if len(self.walk) != len(is_init):
            self.walk = np.zeros(len(is_init), np.int64)
        nearest = (seen.x * 2 >= self.side) * 2 + (seen.y * 2 >= self.side)
        self.walk = np.where(is_init, nearest, self.walk)
        envs = np.arange(len(is_init))
        path = self.walks[self.walk]  # [N, cells, 2]
        safe = seen.grid[envs[:, None], path[..., 0], path[..., 1]] == COVERED_SAFE
        goal = path[envs, safe.argmax(1)]
        return towards(seen.x, seen.y, goal[:, 0], goal[:, 1])


class FramesOracle(FramesPlayer):
    """Sees the POMDP's frames: remembers every number seen and infers where mines may lie.

    Keeps the chance of a mine in each covered cell by fitting independent odds to all numbers seen
    and to the number of mines (iterative proportional fitting), sweeps the nearest cell that is
    surely safe, and otherwise the least likely mine. No memory mends that the first sweeps are
    guesses, and the time limit. But it is no best player: the fit is not exact, so that it now and
    then sweeps a mine where another cell is surely safe, and it does not plan ahead. On Easy the
    best play that remembers everything returns 0.847, computed over all that can be known.

    Args:
        game: The MineSweeper to play.
        rounds: Fitting rounds a step.
    """

    def __init__(self, game: Any, rounds: int = 30) -> None:
        super().__init__(game)
        self.rounds = rounds

    def allocate(self, num_envs: int) -> None:
        """See :meth:`FramesPlayer.allocate`."""
        side = self.level.side
        self.numbers = np.full((num_envs, side, side), -1)  # numbers, -1 where none was seen

    def choose(self, frames: Frames, is_init: Bools) -> Actions:
        """See :meth:`FramesPlayer.choose`."""
        side = self.level.side
        envs = np.arange(len(frames))
        self.numbers[is_init] = -1
        codes = self.screen.board.read(frames, side, side)  # [N, row, column]
        cursor = (codes >= KINDS).reshape(len(frames), -1).argmax(1)
        y = cursor // side
        x = cursor % side
        number = codes[envs, y, x] - KINDS - 1
        self.numbers[envs, y, x] = np.maximum(number, self.numbers[envs, y, x])

        covered = self.numbers < 0
        risk = np.where(covered, mine_chances(self.numbers, self.level.mines, self.rounds), np.inf)
        rows, columns = np.mgrid[:side, :side]
        distance = np.abs(rows - y[:, None, None]) + np.abs(columns - x[:, None, None])
        cost = np.where(risk < 0.02, 0.0, risk) + 1e-3 * distance
        goal = cost.reshape(len(frames), -1).argmin(1)
        return towards(x, y, goal % side, goal // side)


def block_sum(values: Board) -> Board:
    """Sum over the 3 x 3 block around each cell, for values [N, side, side]."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)))
    rows = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    total: Board = rows[:, :, :-2] + rows[:, :, 1:-1] + rows[:, :, 2:]
    return total


def mine_chances(
    numbers: npt.NDArray[np.int64], mines: int, rounds: int
) -> npt.NDArray[np.float64]:
    """Chance of a mine in each covered cell, fitted to the numbers seen: float64 [N, side, side], 0
    in swept cells.

    ``numbers``, int64 [N, side, side], is the number of each swept cell, -1 where covered.
    """
    covered: Board = numbers < 0
    count = np.maximum(covered.sum((1, 2), keepdims=True), 1)
    chance: npt.NDArray[np.float64] = covered * np.minimum(mines / count, 1.0)
    for _ in range(rounds):
        expected = block_sum(chance)
        factor = np.where(~covered, numbers / np.maximum(expected, 1e-9), 1.0)
        log_factor = np.where(~covered, np.log(np.clip(factor, 1e-6, 1e6)), 0.0)
        # Every cell moves by the mean wish of the numbers around it, except that a 0 decides alone.
        near = np.maximum(block_sum((~covered).astype(float)), 1.0)
        chance = covered * np.clip(chance * np.exp(block_sum(log_factor) / near), 0.0, 1.0)
        chance[block_sum(((numbers == 0) & ~covered).astype(float)) > 0] = 0.0
        chance *= (
            np.clip(mines / np.maximum(chance.sum((1, 2), keepdims=True), 1e-9), 0.5, 2.0) ** 0.5
        )
        chance = np.minimum(chance, 1.0)
    return chance
