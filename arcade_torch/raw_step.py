"""What one fused step of an env gives, without a tensordict: for collectors."""

from collections.abc import Collection
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey

from arcade_torch.compiled import EPISODE_REWARD, STEP_COUNT, TERMINATED
from arcade_torch.frame_memory import Canvas

Place = tuple[Canvas, int, torch.Tensor]
"""Where frames are to be drawn: a canvas, the index on its second axis, and the frames there."""


class RawStep(NamedTuple):
    """What one fused step gives."""

    # [N, ...] by key, what to act on next (new episodes have begun); read only
    observation: dict[NestedKey, torch.Tensor]
    numbers: torch.Tensor  # int32 [N, 5], see ``Step.numbers``
    # what the env's ``final_observations`` wants to know of the step
    final: Any

    @property
    def pixels(self) -> torch.Tensor:
        """uint8 [N, S, S, 3], the frames of our own games."""
        return self.observation["pixels"]

    def root_numbers(self, keys: Collection[NestedKey]) -> dict[NestedKey, torch.Tensor]:
        """What the next root says: ``is_init``, ``step_count`` and ``episode_reward`` [N, 1], if
        asked for.
        """
        numbers = self.numbers
        out: dict[NestedKey, torch.Tensor] = {}
        done = numbers[:, TERMINATED:].any(-1, keepdim=True)
        if "is_init" in keys:
            out["is_init"] = done
        if "step_count" in keys:
            out["step_count"] = numbers[:, STEP_COUNT, None].masked_fill(done, 0).to(torch.int64)
        if "episode_reward" in keys:
            out["episode_reward"] = (
                numbers[:, EPISODE_REWARD, None].view(torch.float32).masked_fill(done, 0)
            )
        return out
