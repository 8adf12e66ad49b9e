"""What an ``ArcadeEnv`` takes and gives, as TorchRL specs."""

import torch
from torchrl.data import Categorical, Composite, OneHot, TensorSpec, Unbounded


def action_spec(num_envs: int, num_actions: int, categorical: bool, device: torch.device) -> TensorSpec:
    """Spec of the action: int64 [N] categorical, or one-hot bool [N, num_actions]."""
    if categorical:
        return Categorical(num_actions, shape=(num_envs,), dtype=torch.int64, device=device)
    return OneHot(num_actions, shape=(num_envs, num_actions), dtype=torch.bool, device=device)


def observation_spec(num_envs: int, obs_size: int, num_actions: int, num_tasks: int, device: torch.device) -> Composite:
    """Spec of what the env shows: frames, last action, start flag, steps and return so far; ``task`` if it has some."""
    task = {"task": Categorical(num_tasks, shape=(num_envs,), dtype=torch.int64, device=device)} if num_tasks else {}
    return Composite(
        **task,
        pixels=Unbounded((num_envs, obs_size, obs_size, 3), dtype=torch.uint8, device=device),
        last_action=Categorical(num_actions, shape=(num_envs,), dtype=torch.int64, device=device),
        is_init=Categorical(2, shape=(num_envs, 1), dtype=torch.bool, device=device),
        step_count=Unbounded((num_envs, 1), dtype=torch.int64, device=device),
        episode_reward=Unbounded((num_envs, 1), dtype=torch.float32, device=device),
        shape=(num_envs,),
        device=device,
    )


def done_spec(num_envs: int, device: torch.device) -> Composite:
    """Spec of the three end flags, bool [N, 1] each."""
    flags = {
        name: Categorical(2, shape=(num_envs, 1), dtype=torch.bool, device=device)
        for name in ("done", "terminated", "truncated")
    }
    return Composite(**flags, shape=(num_envs,), device=device)
