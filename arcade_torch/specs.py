"""What an ``ArcadeEnv`` takes and gives: TorchRL specs, and the step without a tensordict."""

from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import torch
from torchrl.data import Categorical, Composite, OneHot, TensorSpec, Unbounded

from arcade_torch.compiled import EPISODE_REWARD, STEP_COUNT, TERMINATED


class RawStep(NamedTuple):
    """What one fused step gives."""

    # uint8 [N, S, S, 3], the frames to act on next (new episodes have begun); read only
    pixels: torch.Tensor
    numbers: torch.Tensor  # int32 [N, 5], see ``Step.numbers``
    # the games' states before the resets, and who saw the partial view
    final: tuple[Any, jax.Array]

    def root_numbers(self, keys: Collection[str]) -> dict[str, torch.Tensor]:
        """What the next root says: ``is_init``, ``step_count`` and ``episode_reward`` [N, 1], if
        asked for.
        """
        numbers = self.numbers
        out = {}
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


def make_specs(
    num_envs: int,
    obs_size: int,
    num_actions: int,
    num_tasks: int,
    one_hot: bool,
    device: torch.device,
) -> tuple[TensorSpec, Composite, TensorSpec, Composite]:
    """Specs of action, observation, reward and the three end flags; there is a ``task`` if there
    are some.
    """

    def flag() -> Categorical:
        return Categorical(2, shape=(num_envs, 1), dtype=torch.bool, device=device)

    action: TensorSpec = Categorical(
        num_actions, shape=(num_envs,), dtype=torch.int64, device=device
    )
    if one_hot:
        action = OneHot(num_actions, shape=(num_envs, num_actions), dtype=torch.bool, device=device)
    task = (
        {"task": Categorical(num_tasks, shape=(num_envs,), dtype=torch.int64, device=device)}
        if num_tasks
        else {}
    )
    observation = Composite(
        **task,
        pixels=Unbounded((num_envs, obs_size, obs_size, 3), dtype=torch.uint8, device=device),
        last_action=Categorical(num_actions, shape=(num_envs,), dtype=torch.int64, device=device),
        is_init=flag(),
        step_count=Unbounded((num_envs, 1), dtype=torch.int64, device=device),
        episode_reward=Unbounded((num_envs, 1), dtype=torch.float32, device=device),
        shape=(num_envs,),
        device=device,
    )
    done = Composite(
        done=flag(), terminated=flag(), truncated=flag(), shape=(num_envs,), device=device
    )
    return action, observation, Unbounded((num_envs, 1), dtype=torch.float32, device=device), done
