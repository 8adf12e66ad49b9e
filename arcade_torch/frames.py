"""Frames stored once: the next frame of step t is frame t + 1, but for ends and the last step, which have a pool.

A batch of sequences holds ``pixels`` [B, L, ...] and, for every step whose successor is *not* the following entry, a
row number ``("next", "frame_slot")`` into a small pool of further frames. ``next_pixels`` puts both together.
"""

from typing import Any

import torch
from tensordict import TensorDictBase


class FramePool:
    """Frames that belong to no position of a sequence: final frames of episodes, and the frames after the last step.

    Args:
        frame_shape: Shape of one frame.
        capacity: Number of frames to make room for; grows by doubling when needed.
        device: Where the frames live.
    """

    def __init__(self, frame_shape: torch.Size, capacity: int, device: torch.device | None = None) -> None:
        self._buffer = torch.empty((max(capacity, 1), *frame_shape), dtype=torch.uint8, device=device)
        self._used = 0

    @property
    def pixels(self) -> torch.Tensor:
        """uint8 [K, ...]: the frames in use. A view, to be read only."""
        return self._buffer[: self._used]

    def __len__(self) -> int:
        """Number of frames in use."""
        return self._used

    def resize(self, count: int) -> None:
        """Keep the first ``count`` slots; slots that were not in use hold anything until they are written."""
        if count > self._buffer.shape[0]:
            grown = self._buffer.new_empty((max(count, 2 * self._buffer.shape[0]), *self._buffer.shape[1:]))
            grown[: self._used] = self.pixels
            self._buffer = grown
        self._used = count

    def append(self, frames: torch.Tensor) -> torch.Tensor:
        """Add frames.

        Args:
            frames: uint8 [n, ...].

        Returns:
            int64 [n], their slots.
        """
        first, count = self._used, frames.shape[0]
        self.resize(first + count)
        self._buffer[first : first + count] = frames
        return torch.arange(first, first + count, device=self._buffer.device)

    def __deepcopy__(self, memo: dict[int, Any]) -> "FramePool":
        """Copy the frames in use and no spare room; ``TensorDict.clone`` comes here."""
        copied = FramePool(self._buffer.shape[1:], 1, self._buffer.device)
        copied._buffer = self.pixels.clone()
        copied._used = self._used
        return copied

    def __repr__(self) -> str:
        """Count and shape."""
        return f"FramePool({self._used} frames of {tuple(self._buffer.shape[1:])})"


def shift_next(current: torch.Tensor, pool: torch.Tensor, slot: torch.Tensor) -> torch.Tensor:
    """Value at the *next* observation of every step, from values at the observations and at the pool.

    Works on frames and on anything computed frame by frame (features, values), and lets gradients through.

    Args:
        current: [B, L, ...], values at the observations.
        pool: [K, ...], values at the pool's frames.
        slot: int64 [B, L, 1], row of the pool, or -1 where the next entry of ``current`` is meant.

    Returns:
        [B, L, ...], a new tensor.

    Raises:
        ValueError: The last step has no slot, so its successor is unknown.

    Example:
        >>> current, pool = torch.tensor([[1, 2, 3]]), torch.tensor([4, 9])
        >>> shift_next(current, pool, torch.tensor([[[-1], [1], [0]]]))
        tensor([[2, 9, 4]])
    """
    slot = slot.squeeze(-1)
    if bool((slot[:, -1] < 0).any()):
        raise ValueError("the last step of the batch has no successor: it was cut in time; select whole rows")
    shifted = torch.cat([current[:, 1:], current[:, -1:]], dim=1)
    ended = slot >= 0
    shifted[ended] = pool[slot[ended]]
    return shifted


def next_pixels(batch: TensorDictBase) -> torch.Tensor:
    """The frame that followed every step, the true final frame at ends as far as it was kept.

    Args:
        batch: What ``ArcadeCollector.collect`` gave, or any rows of it.

    Returns:
        uint8 [B, L, ...], a new tensor. Where an episode ended and its final frame was not kept
        (``final_frames="none"``), the first frame of the next episode.

    Raises:
        KeyError: The batch has no pool of frames.
    """
    if "next_pool" not in batch:
        raise KeyError("the batch has no 'next_pool': it is not from ArcadeCollector, or its next frames are dense")
    pool: FramePool = batch["next_pool"]
    pixels = batch["pixels"]
    return shift_next(pixels, pool.pixels.to(pixels.device), batch["next", "frame_slot"])
