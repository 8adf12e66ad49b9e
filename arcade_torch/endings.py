"""The final states of episodes that ended in a window, kept until their frames are drawn, many at once."""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import torch

from arcade_torch.compiled import CompiledGame, Step
from arcade_torch.dlpack import to_torch

# Frames are drawn in portions of one size, an eighth of the batch but some at least, so that one compiled shape serves.
_SHARE, _AT_LEAST = 8, 4


class FinalStates:
    """Collects final states, then draws them.

    A compiled call a step would cost more than the frames; picking rows out of host memory costs next to nothing.

    Args:
        compiled: The game.
        num_envs: Number of envs in the batch.
        device: Where the frames are wanted.
    """

    def __init__(self, compiled: CompiledGame, num_envs: int, device: torch.device) -> None:
        self._compiled = compiled
        self._portion = min(num_envs, max(_AT_LEAST, num_envs // _SHARE))
        self._device = device
        self._taken: list[tuple[int, np.ndarray, Any]] = []

    def add(self, time: int, rows: np.ndarray, step: Step) -> None:
        """Keep the final states of some envs.

        Args:
            time: Any number to know them by.
            rows: int64 [n], the envs whose episodes ended.
            step: The step in which they ended.
        """
        states = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], (step.final_state, step.root.partial))
        self._taken.append((time, rows, states))

    def clear(self) -> None:
        """Forget what was added."""
        self._taken.clear()

    def draw(self) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Draw what was added, portion by portion, and forget it.

        Yields:
            int64 [n] times, int64 [n] rows, uint8 [n, S, S, 3] frames, in the order they were added.
        """
        if not self._taken:
            return
        times = np.concatenate([np.full(len(rows), time) for time, rows, _ in self._taken])
        rows = np.concatenate([rows for _, rows, _ in self._taken])
        states = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(states for _, _, states in self._taken))
        self.clear()
        for first in range(0, len(rows), self._portion):
            portion = slice(first, first + self._portion)
            index = np.arange(len(rows))[portion]
            index = np.pad(index, (0, self._portion - len(index)), mode="edge")
            frames = self._compiled.draw(*jax.tree.map(lambda leaf, index=index: leaf[index], states))
            when, where = torch.from_numpy(times[portion]), torch.from_numpy(rows[portion])
            yield when.to(self._device), where.to(self._device), to_torch(frames, self._device)[: len(where)]
