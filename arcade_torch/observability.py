"""Which envs of a batch show the Markov state (MDP) and which the partial view (POMDP). Loads no
torch.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.validation import format_value, plain

Observability = Literal["full", "partial"] | npt.ArrayLike  # a tensor is array-like too

_ALLOWED = "allowed: 'full', 'partial', or bools, one an env (True = partial)"


def partial_flags(
    observability: Observability | None, num_envs: int, partial_obs: bool | None = None
) -> npt.NDArray[np.bool_]:
    """Turn what a user may write into one flag an env.

    Args:
        observability: ``"full"``, ``"partial"``, or bool [num_envs], array or tensor; None if not
            given.
        num_envs: Number of envs.
        partial_obs: The alias: true means ``"partial"``; None if not given.

    Returns:
        bool [num_envs], true where the env shows its POMDP twin. False everywhere if neither is
        given. A new array.

    Raises:
        ValueError: Both are given, or another word, type or shape.
        TypeError: ``partial_obs`` is no bool.
    """
    partial_obs = plain(partial_obs)
    if partial_obs is not None:
        if observability is not None:
            raise ValueError(
                "observability and partial_obs are given: keep observability, partial_obs is its "
                "alias"
            )
        if not isinstance(partial_obs, bool):
            raise TypeError(f"partial_obs is {format_value(partial_obs)}, allowed: True, False")
        return np.full(num_envs, partial_obs)
    if observability is None or isinstance(observability, str):
        if observability not in (None, "full", "partial"):
            raise ValueError(f"observability is {format_value(observability)}, {_ALLOWED}")
        return np.full(num_envs, observability == "partial")
    try:
        flags = np.array(
            observability.cpu().numpy() if hasattr(observability, "cpu") else observability
        )
    except ValueError:  # rows of different lengths
        flags = np.array(None)
    if flags.dtype != np.bool_ or flags.shape != (num_envs,):
        raise ValueError(
            f"observability is {flags.dtype} {flags.shape}, expected bool ({num_envs},): {_ALLOWED}"
        )
    return flags


def changed_flags(observability: Observability, num_envs: int) -> npt.NDArray[np.bool_]:
    """The flags of running envs whose twin is changed, as :func:`partial_flags` gives them; a
    ValueError for None too.
    """
    if observability is None:
        raise ValueError(f"observability is None, {_ALLOWED}")
    return partial_flags(observability, num_envs)
