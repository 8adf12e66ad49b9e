"""What ``ArcadeCollector`` refuses, in one clear line each."""

import inspect
from collections.abc import Collection, Iterable, Iterator
from typing import Any, get_args

from torchrl.envs.utils import ExplorationType

from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.jax_env import JaxEnv
from arcade_torch.policies import check_state_keys, path_of
from arcade_torch.rollout_buffer import FinalFrames
from arcade_torch.validation import whole

_PLACES = ("final_mask", "final_index")


def _parameters(policy: Any) -> Collection[str]:
    """The names of what a policy takes that is no TensorDict module; empty where nobody can say."""
    if policy is None or hasattr(policy, "in_keys"):
        return ()
    try:
        return inspect.signature(getattr(policy, "forward", policy)).parameters
    except (TypeError, ValueError):  # of a function that is compiled
        return ()


def check_random_frames(init_random_frames: Any) -> int:
    """The number of random frames; raises unless it is a whole number from 0."""
    frames = whole("init_random_frames", init_random_frames)
    if frames < 0:
        raise ValueError(f"init_random_frames is {frames}, expected an int of 0 or more")
    return frames


def check_options(exploration_type: Any, store: Any, compress: Any, hook: Any) -> None:
    """Raise TypeError for options that a window would trip over."""
    if exploration_type is not None and not isinstance(exploration_type, ExplorationType):
        raise TypeError(
            f"exploration_type is {exploration_type!r}, expected one of torchrl's ExplorationType"
        )
    if store is not None and not isinstance(store, Iterator):  # which is read once
        is_list = isinstance(store, Iterable) and not isinstance(store, str)
        if not is_list or not all(map(_is_key, store)):
            raise TypeError(f"store is {store!r}, expected a list of keys, or None for all")
    for name, function in (("compress", compress), ("post_collect_hook", hook)):
        if function is not None and not callable(function):
            raise TypeError(f"{name} is a {type(function).__name__}, expected a function")


def _is_key(key: Any) -> bool:
    """Whether it can be the key of an entry."""
    parts = key if isinstance(key, tuple) else (key,)
    return all(isinstance(part, str) for part in parts)


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
    check_state_keys(policy)
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
    _check_names({path_of(key)[0] for key in env.observation_keys}, final_frames)
    if compress is not None and len(env.observation_keys) > 1:
        names = ", ".join(map(str, env.observation_keys))
        raise ValueError(f"compress takes one array, and the env observes several: {names}")


def _check_names(names: Collection[str], final_frames: str) -> None:
    """Refuse observations that are called as other entries of a batch: one would take the place of
    the other.
    """
    for name in ("collector", "initial_state"):
        if name in names:
            raise ValueError(
                f"the env observes {name!r}, which is an entry of every batch: give it another name"
            )
    if final_frames == "all":
        return
    finals = {f"final_{name}" for name in names}
    for name in sorted(names):
        if name in finals or name in _PLACES or f"final_{name}" in _PLACES:
            raise ValueError(
                f"the env observes {name!r}, and final observations stand under final_KEY, their "
                "places under final_mask and final_index: give it another name, or collect with "
                "final_frames='all'"
            )
