"""Scripted players of Navigator: both walk a shortest path, one of them on a map that it saw
once.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import FIRE
from arcade_torch.envs_jax.navigator.renderer import KINDS
from arcade_torch.envs_jax.navigator.rules import TNT, TREASURE

Board = npt.NDArray[Any]
FAR = 10_000  # more moves than any path has


def _beside(values: Board) -> Board:
    """The four neighbours' values in the order of the actions up, down, left, right: [4, N, x, y];
    FAR outside.
    """
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)), constant_values=FAR)
    return np.stack(
        [padded[:, 1:-1, :-2], padded[:, 1:-1, 2:], padded[:, :-2, 1:-1], padded[:, 2:, 1:-1]]
    )


def path_lengths(board: Board) -> npt.NDArray[np.int64]:
    """Moves to the treasure from every cell, around the TNT: int64 [N, x, y], FAR where there is no
    way.

    Args:
        board: int [N, side, side] of ``FREE``, ``TNT`` and ``TREASURE``.
    """
    length = np.where(board == TREASURE, 0, FAR)
    while True:
        shorter = np.where(board == TNT, FAR, np.minimum(length, _beside(length).min(0) + 1))
        if np.array_equal(shorter, length):
            return length
        length = shorter


class _Walker:
    """Follows the shortest path on a remembered map; opens where it stands if that is the treasure
    or walled in.
    """

    def __init__(self, side: int) -> None:
        self.length: npt.NDArray[np.int64] = np.zeros((0, side, side), np.int64)

    def remember(self, board: Board, is_init: npt.NDArray[np.bool_]) -> None:
        """Keep the maps (int [N, side, side]) of the envs whose episode begins."""
        if len(self.length) != len(is_init):
            self.length = np.full(board.shape, FAR)
        if is_init.any():
            self.length[is_init] = path_lengths(board[is_init])

    def walk(self, x: Board, y: Board) -> npt.NDArray[np.int32]:
        """The action of every agent, int32 [N], from its place (x, y), int [N] each."""
        envs = np.arange(len(x))
        ahead = _beside(self.length)[:, envs, x, y]
        best: npt.NDArray[np.int64] = ahead.argmin(0)
        arrived = self.length[envs, x, y] == 0
        return np.where(arrived | (ahead.min(0) >= FAR), FIRE, best).astype(np.int32)


class StateOracle(_Walker):
    """Sees the map; its return is ``1 - 0.5 d / cells`` after the shortest path of d moves."""

    def __init__(self, game: Any) -> None:
        super().__init__(game.level.side)

    def act(self, seen: Any, is_init: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        self.remember(seen.board, is_init)
        return self.walk(seen.x, seen.y)


class FramesOracle(_Walker):
    """Sees the POMDP's frames: remembers the map of the first, and reads the agent's place in each.

    It walks as well as one that sees the map throughout.
    """

    def __init__(self, game: Any) -> None:
        super().__init__(game.level.side)
        self.screen = game.screen
        self.side = game.level.side

    def act(
        self, seen: npt.NDArray[np.uint8], is_init: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.int32]:
        """See :class:`~arcade_torch.envs_jax.oracles.Player`."""
        codes = self.screen.board.read(seen, self.side, self.side).swapaxes(1, 2)  # [N, x, y]
        self.remember(codes % KINDS, is_init)
        place = (codes >= KINDS).reshape(len(seen), -1).argmax(1)
        return self.walk(place // self.side, place % self.side)
