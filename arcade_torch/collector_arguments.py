"""What ``ArcadeCollector`` refuses, in one clear line each."""

from typing import Any, get_args

from arcade_torch.env import ArcadeEnv
from arcade_torch.jax_env import JaxEnv
from arcade_torch.rollout_buffer import FinalFrames


def check_arguments(
    env: Any, policy: Any, frames_per_batch: int, overlap: int, final_frames: str, compress: Any
) -> None:
    """Raise TypeError or ValueError for what cannot work, before anything is allocated."""
    if not isinstance(env, ArcadeEnv | JaxEnv):
        raise TypeError(
            f"env is a {type(env).__name__}, expected an ArcadeEnv or what from_jax gives; others "
            "go with torchrl's Collector"
        )
    if isinstance(env, ArcadeEnv) and env.one_hot:
        raise ValueError(
            "ArcadeCollector stores actions as integers: make the env with categorical_actions=True"
        )
    if policy is not None and not callable(policy):
        raise TypeError(
            f"policy is a {type(policy).__name__}, expected a TensorDictModule, a callable, or "
            "None for random actions"
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
