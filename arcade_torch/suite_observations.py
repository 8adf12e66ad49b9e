"""The observations of an env of another suite: their keys in a tensordict."""

from typing import Any

import jax
import numpy as np

_OWN_KEYS = (
    "action", "last_action", "is_init", "step_count", "episode_reward",
    "reward", "done", "terminated", "truncated", "next", "_reset", "_step",
)  # fmt: skip


def leaf_names(obs: Any, obs_key: str | None) -> list[Any]:
    """A key of a tensordict for every leaf of an observation, a string or a tuple of strings."""
    leaves = jax.tree_util.tree_flatten_with_path(obs)[0]
    is_array = len(leaves) == 1 and not leaves[0][0]
    paths = [tuple(jax.tree_util.keystr((key,), simple=True) for key in path) for path, _ in leaves]
    if obs_key is not None and (not isinstance(obs_key, str) or not obs_key):
        raise TypeError(f"obs_key is {obs_key!r}, expected a name")
    if is_array:
        array = leaves[0][1]
        is_picture = array.dtype == np.uint8 and array.ndim == 4
        paths = [(obs_key or ("pixels" if is_picture else "observation"),)]
    elif obs_key is not None:
        arrived = ", ".join("/".join(path) for path in paths)
        raise ValueError(
            f"obs_key is {obs_key!r}, and the observation has names of its own: {arrived}; leave "
            "obs_key out"
        )
    _check_names(paths)
    return [path[0] if len(path) == 1 else path for path in paths]


def _check_names(paths: list[tuple[str, ...]]) -> None:
    """Refuse observations that cannot have these names in a tensordict (ValueError)."""
    for path in paths:
        if "" in path:
            raise ValueError(
                "the observation has an entry with an empty name, for which TorchRL has no specs: "
                "give it a name"
            )
        if path[0] in _OWN_KEYS:
            raise ValueError(
                f"the observation has an entry {path[0]!r}, which is a key of the env itself: "
                "give it another name"
            )
