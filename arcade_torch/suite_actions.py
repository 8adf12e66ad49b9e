"""The actions of an env of another suite: their spec, and whether those that arrive fit it."""

from typing import Any

import jax
import numpy as np
import torch
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from arcade_torch import validation
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.suite import Suite, described, name_of

_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
_FLOATS = (torch.float32, torch.float64, torch.float16, torch.bfloat16)


def action_spec(
    suite: Suite, given: TensorSpec | None, num_envs: int, device: torch.device
) -> TensorSpec:
    """The spec of actions [N, ...]: what was given, or from the env's action space.

    Raises:
        TypeError: A spec of a kind or type that is not taken.
        ValueError: A spec of another number of envs, or an action space that is not known.
    """
    if given is not None:
        _check_spec(given, num_envs)
        return given.to(device)
    space: Any = getattr(suite.env, "action_space", None)
    if callable(space):
        space = space(*suite.extra)
    categories: Any = getattr(space, "n", None)
    if categories is not None and np.ndim(categories) == 0:
        _check_choice(suite, space, num_envs)
        return Categorical(int(categories), shape=(num_envs,), dtype=torch.int64, device=device)
    if hasattr(space, "low") and hasattr(space, "high") and hasattr(space, "shape"):
        return _box(suite, space, num_envs, device)
    raise ValueError(
        f"the actions of {name_of(suite.env)} are {described(space)}, expected a space with n, or "
        "with low, high and shape: pass action_spec=, for instance "
        f"torchrl.data.Categorical(4, shape=({num_envs},))"
    )


def action_of_one(spec: TensorSpec) -> jax.ShapeDtypeStruct:
    """Shape and type of the action that one env gets: int32 or float32."""
    dtype = np.int32 if spec.dtype in _INTEGERS else np.float32
    return jax.ShapeDtypeStruct(tuple(spec.shape[1:]), dtype)


def check_action(action: Any, spec: TensorSpec, check_range: bool) -> None:
    """Raise unless actions fit their spec; numbers of floats are not looked at.

    Args:
        action: What arrived.
        spec: Of :func:`action_spec`.
        check_range: Whether integers are looked at too, which makes the host wait for a GPU.

    Raises:
        TypeError: No tensor, or no integers where the spec has integers.
        ValueError: Another shape, or integers out of range.
    """
    if isinstance(spec, Categorical):
        validation.check_integers(action, spec.shape[0], spec.space.n, check_range)
        return
    validation.check_tensor(action, "action")
    if action.shape != spec.shape:
        expected = list(spec.shape)
        raise ValueError(f"action has shape {list(action.shape)}, expected {expected}")
    if spec.dtype not in _INTEGERS:
        return
    if action.dtype not in _INTEGERS:
        raise TypeError(f"action has dtype {action.dtype}, expected integers such as torch.int64")
    if check_range and not ((action >= spec.space.low) & (action <= spec.space.high)).all():
        raise ValueError(
            f"actions range from {int(action.min())} to {int(action.max())}, allowed: "
            f"{int(spec.space.low.min())} to {int(spec.space.high.max())}"
        )


def as_got(action: torch.Tensor) -> torch.Tensor:
    """Actions as the env gets them: floats have the precision of float32."""
    return action.float().double() if action.dtype is torch.float64 else action


def _check_spec(spec: TensorSpec, num_envs: int) -> None:
    """Refuse a spec whose actions nobody could hand to the env."""
    # subclasses of Categorical, such as OneHot and MultiCategorical, are another thing
    is_categorical = type(spec) is Categorical
    if not is_categorical and not isinstance(spec, Bounded | Unbounded):
        raise TypeError(
            f"action_spec is {kind_of(spec)}, expected Categorical or Bounded; several "
            f"choices at once are Bounded(0, n - 1, shape=({num_envs}, k), dtype=torch.int64)"
        )
    if spec.dtype not in (_INTEGERS if is_categorical else _INTEGERS + _FLOATS):
        raise TypeError(
            f"action_spec is of {spec.dtype}, expected integers"
            + ("" if is_categorical else " or floats")
        )
    if isinstance(spec, Unbounded) and spec.dtype in _INTEGERS:
        raise TypeError("action_spec is of integers without bounds: pass Bounded(low, high, ...)")
    if spec.shape[:1] != (num_envs,):
        raise ValueError(f"action_spec has shape {list(spec.shape)}, expected [{num_envs}, ...]")
    if is_categorical and len(spec.shape) != 1:
        raise ValueError(
            f"action_spec is a Categorical of shape {list(spec.shape)}, expected [{num_envs}]; "
            f"several choices at once are Bounded(0, {spec.space.n - 1}, "
            f"shape={tuple(spec.shape)}, dtype=torch.int64)"
        )


def _check_choice(suite: Suite, space: Any, num_envs: int) -> None:
    """Refuse a space with ``n`` that is something else than one number from 0 to n - 1, such as
    Gymnasium's MultiBinary, or its Discrete with a start.
    """
    shape = tuple(getattr(space, "shape", None) or ())
    start = getattr(space, "start", 0)
    if shape:
        raise ValueError(
            f"the actions of {name_of(suite.env)} are {described(space)} of shape {list(shape)}, "
            "expected one choice: pass action_spec=, for instance "
            f"torchrl.data.Bounded(0, 1, shape={(num_envs, *shape)}, dtype=torch.int64)"
        )
    if start != 0:
        raise ValueError(
            f"the actions of {name_of(suite.env)} begin at {start}, expected 0: let step add "
            f"{start}, and pass action_spec=torchrl.data.Categorical({space.n}, "
            f"shape=({num_envs},))"
        )


def _box(suite: Suite, space: Any, num_envs: int, device: torch.device) -> TensorSpec:
    """The spec of a space with ``low``, ``high`` and ``shape``."""
    shape = (num_envs, *space.shape)
    is_integer = np.issubdtype(np.dtype(getattr(space, "dtype", None) or np.float32), np.integer)
    dtype = torch.int64 if is_integer else torch.float32
    bounds = []
    for bound in (space.low, space.high):
        full = np.broadcast_to(np.asarray(bound, np.int64 if is_integer else np.float32), shape)
        bounds.append(torch.from_numpy(full.copy()).to(device))
    finite = [bound.isfinite() for bound in bounds]
    if not torch.stack(finite).any():
        return Unbounded(shape, dtype=dtype, device=device)
    if not torch.stack(finite).all():
        raise ValueError(
            f"the actions of {name_of(suite.env)} have an infinite bound, within which nobody can "
            f"draw: pass action_spec=, for instance torchrl.data.Unbounded({shape})"
        )
    return Bounded(*bounds, shape=shape, dtype=dtype, device=device)
