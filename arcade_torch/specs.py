"""TorchRL's specs of what an ``ArcadeEnv`` takes and gives."""

import torch
from torchrl.data import Categorical, Composite, OneHot, TensorSpec, Unbounded


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
    task = {}
    if num_tasks:
        task["task"] = Categorical(num_tasks, shape=(num_envs,), dtype=torch.int64, device=device)
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
