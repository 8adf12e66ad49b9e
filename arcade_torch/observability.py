"""Which envs of a batch show the Markov state (MDP) and which the partial view (POMDP)."""

from typing import Literal

import torch

from arcade_torch.envs_jax.shown import shown

Observability = Literal["full", "partial"] | torch.Tensor

_ALLOWED = "allowed: 'full', 'partial', or a bool tensor with one flag an env (True = partial)"


def partial_flags(observability: Observability, num_envs: int) -> torch.Tensor:
    """Turn what a user may write into one flag an env.

    Args:
        observability: ``"full"``, ``"partial"``, or bool [num_envs].
        num_envs: Number of envs.

    Returns:
        bool [num_envs] on the CPU, true where the env shows its POMDP twin. A new tensor.

    Raises:
        ValueError: Another word or another shape.
        TypeError: Not a word and not a bool tensor.

    Example:
        >>> partial_flags("partial", 2)
        tensor([True, True])
    """
    if isinstance(observability, str):
        if observability not in ("full", "partial"):
            raise ValueError(f"observability is {shown(observability)}, {_ALLOWED}")
        return torch.full((num_envs,), observability == "partial")
    if not isinstance(observability, torch.Tensor):
        raise TypeError(f"observability is a {type(observability).__name__}, {_ALLOWED}")
    if observability.dtype is not torch.bool:
        raise TypeError(f"observability has dtype {observability.dtype}, {_ALLOWED}")
    if observability.shape != (num_envs,):
        raise ValueError(f"observability has shape {tuple(observability.shape)}, expected ({num_envs},): {_ALLOWED}")
    return observability.to("cpu", copy=True)


def resolve_observability(observability: Observability | None, partial_obs: bool | None, num_envs: int) -> torch.Tensor:
    """Merge ``observability`` with its alias ``partial_obs``.

    Args:
        observability: See ``partial_flags``; None if not given.
        partial_obs: The alias: true means ``"partial"``; None if not given.
        num_envs: Number of envs.

    Returns:
        bool [num_envs]. Full observability if neither is given.

    Raises:
        ValueError: Both are given.
        TypeError: ``partial_obs`` is no bool.
    """
    if partial_obs is None:
        return partial_flags("full" if observability is None else observability, num_envs)
    if observability is not None:
        raise ValueError("both observability and partial_obs are given: keep observability, partial_obs is its alias")
    if not isinstance(partial_obs, bool):
        raise TypeError(
            f"partial_obs is {shown(partial_obs)}, allowed: True, False; for a mixed batch use observability"
        )
    return partial_flags("partial" if partial_obs else "full", num_envs)
