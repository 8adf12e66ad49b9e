"""What ``ArcadeCollector`` refuses, in one clear line each."""

import inspect
from collections.abc import Collection
from typing import Any, get_args

from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.jax_env import JaxEnv
from arcade_torch.rollout_buffer import FinalFrames


def _parameters(policy: Any) -> Collection[str]:
    """The names of what a policy takes that is no TensorDict module; empty where nobody can say."""
    if policy is None or hasattr(policy, "in_keys"):
        return ()
    try:
        return inspect.signature(getattr(policy, "forward", policy)).parameters
    except (TypeError, ValueError):  # of a function that is compiled
        return ()


def check_arguments(
    env: Any, policy: Any, frames_per_batch: int, overlap: int, final_frames: str, compress: Any
) -> None:
    """Raise TypeError or ValueError for what cannot work, before anything is allocated."""
    if not isinstance(env, ArcadeEnv | JaxEnv):
        raise TypeError(
            f"env is {kind_of(env)}, expected an ArcadeEnv or what from_jax gives; others "
            "go with torchrl's Collector, a function that makes one is called first"
        )
    if isinstance(env, ArcadeEnv) and env.one_hot:
        raise ValueError(
            "ArcadeCollector stores actions as integers: make the env with categorical_actions=True"
        )
    if policy is not None and not callable(policy):
        raise TypeError(
            f"policy is {kind_of(policy)}, expected a TensorDictModule, a callable, or "
            "None for random actions"
        )
    tensors = [str(key) for key in env.observation_keys if key in _parameters(policy)]
    if tensors:
        raise TypeError(
            f"policy takes the tensor {', '.join(tensors)}, expected one that takes a TensorDict: "
            f"pass TensorDictModule(policy, {tensors}, ['action'])"
        )
    num_envs = env.num_envs
    if frames_per_batch < num_envs or frames_per_batch % num_envs:
        raise ValueError(
            f"frames_per_batch is {frames_per_batch}, expected an int multiple of num_envs "
            f"({num_envs})"
        )
    if overlap < 0:
        raise ValueError(f"overlap is {overlap}, expected an int of 0 or more")
    if final_frames not in get_args(FinalFrames):
        raise ValueError(
            f"final_frames is {final_frames!r}, allowed: "
            f"{', '.join(map(repr, get_args(FinalFrames)))}"
        )
    if compress is not None and len(env.observation_keys) > 1:
        names = ", ".join(map(str, env.observation_keys))
        raise ValueError(f"compress takes one array, and the env observes several: {names}")
