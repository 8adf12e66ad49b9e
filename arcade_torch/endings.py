"""The final states of episodes that ended in a window, kept until their frames are drawn, many at once."""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import torch

from arcade_torch.compiled import CompiledGame, Step
from arcade_torch.dlpack import to_torch
from arcade_torch.envs_jax.batch import BatchedGame

# Frames are drawn in portions of one size, an eighth of the batch but some at least, so that one compiled shape serves.
_SHARE, _AT_LEAST = 8, 4


class FinalStates:
    """Collects final states, then draws them.

    A compiled call a step would cost more than the frames; picking rows out of host memory costs next to nothing.

    Args:
        compiled: The game, or the mixture of games.
        num_envs: Number of envs in the batch.
        device: Where the frames are wanted.
    """

    def __init__(self, compiled: CompiledGame, num_envs: int, device: torch.device) -> None:
        batched = compiled.batched
        self._states = batched.states
        self._groups = [
            _OfOneGame(group, rows, device) for group, rows in zip(batched.groups, batched.rows(num_envs), strict=True)
        ]

    def add(self, time: int, rows: np.ndarray, step: Step) -> None:
        """Keep the final states of some envs.

        Args:
            time: Any number to know them by.
            rows: int64 [n], the envs whose episodes ended.
            step: The step in which they ended.
        """
        for group, states in zip(self._groups, self._states(step.final_state), strict=True):
            group.add(time, rows, states, step.root.partial)

    def clear(self) -> None:
        """Forget what was added."""
        for group in self._groups:
            group.taken.clear()

    def draw(self) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Draw what was added, portion by portion, and forget it.

        Yields:
            int64 [n] times, int64 [n] rows, uint8 [n, S, S, 3] frames, game by game in the order they were added.
        """
        for group in self._groups:
            yield from group.draw()


class _OfOneGame:
    """The final states of the envs that play one game."""

    def __init__(self, game: BatchedGame[Any], rows: slice, device: torch.device) -> None:
        self._draw = game.draw
        self._first, self._last = rows.start, rows.stop
        size = rows.stop - rows.start
        self._portion = min(size, max(_AT_LEAST, size // _SHARE))
        self._device = device
        self.taken: list[tuple[int, np.ndarray, Any]] = []

    def add(self, time: int, rows: np.ndarray, states: Any, partial: jax.Array) -> None:
        """Keep the states (leaves [n, ...]) of those ``rows`` that are this game's."""
        rows = rows[(rows >= self._first) & (rows < self._last)]
        if len(rows):
            own = rows - self._first
            kept = jax.tree.map(lambda leaf: np.asarray(leaf)[own], states), np.asarray(partial)[rows]
            self.taken.append((time, rows, kept))

    def draw(self) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """See ``FinalStates``."""
        if not self.taken:
            return
        times = np.concatenate([np.full(len(rows), time) for time, rows, _ in self.taken])
        rows = np.concatenate([rows for _, rows, _ in self.taken])
        states = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(states for _, _, states in self.taken))
        self.taken.clear()
        for first in range(0, len(rows), self._portion):
            portion = slice(first, first + self._portion)
            index = np.arange(len(rows))[portion]
            index = np.pad(index, (0, self._portion - len(index)), mode="edge")
            frames = self._draw(*jax.tree.map(lambda leaf, index=index: leaf[index], states))
            when, where = torch.from_numpy(times[portion]), torch.from_numpy(rows[portion])
            yield when.to(self._device), where.to(self._device), to_torch(frames, self._device)[: len(where)]
