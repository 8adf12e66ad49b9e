"""What ``ArcadeEnv`` refuses: arguments, tensordicts and entries that it could not use, in one
clear line each.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase

from arcade_torch.envs_jax.validation import format_value, kind_of, plain
from arcade_torch.process import warn

# integers of torch: the type of numpy under which negative numbers are large
_UNSIGNED = {
    torch.int64: np.uint64,
    torch.int32: np.uint32,
    torch.int16: np.uint16,
    torch.int8: np.uint8,
    torch.uint8: np.uint8,
}


def check_flags(names: str, values: Sequence[Any]) -> None:
    """Raise unless the options ``names`` (separated by spaces) are bools; ``task_in_td`` may also
    be None.
    """
    for name, value in zip(names.split(), values, strict=True):
        if not isinstance(plain(value), bool) and not (value is None and name == "task_in_td"):
            raise TypeError(f"{name} is {format_value(value)}, allowed: True, False")


def whole(name: str, value: Any) -> int:
    """A whole number as an int of Python; raises TypeError for anything else."""
    value = plain(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name} is {format_value(value)}, expected an int")
    return value


def check_tensordict(td: Any, num_envs: int) -> None:
    """Raise if ``step`` and ``reset`` cannot use a tensordict: its kind, batch size, ``next`` or
    ``_step``.
    """
    if not isinstance(td, TensorDictBase):
        raise TypeError(f"got {kind_of(td)}, expected a TensorDict of batch size [{num_envs}]")
    if td.batch_size != (num_envs,):
        raise ValueError(
            f"the tensordict has batch_size {list(td.batch_size)}, expected [{num_envs}], one row "
            "an env"
        )
    following = td.get("next", None)
    if following is not None and not isinstance(following, TensorDictBase):
        raise TypeError(
            f"entry 'next' is {kind_of(following)}, expected a TensorDict: leave it out"
        )
    if "_step" in td:
        steps = mask(td, "_step", num_envs)
        if following is None and not bool(steps.any()):
            raise ValueError("entry '_step' is false in all envs: there is nothing to step")


def tensor(td: TensorDictBase, key: str) -> torch.Tensor:
    """The entry ``key``; raises if there is none, or it is no dense tensor."""
    value = td.get(key, None)
    if value is None:
        raise ValueError(
            f"the tensordict has no entry {key!r}; it has "
            f"{', '.join(map(str, td.keys())) or 'none'}"
        )
    check_tensor(value, f"entry {key!r}")
    dense: torch.Tensor = value
    return dense


def check_tensor(value: Any, name: str) -> None:
    """Raise TypeError unless ``value``, called ``name``, is a dense tensor."""
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{name} is {kind_of(value)}, expected a tensor")
    if value.layout is not torch.strided:
        raise TypeError(
            f"{name} is a {value.layout} tensor, expected a dense one: pass .to_dense()"
        )


def check_integers(
    action: torch.Tensor, num_envs: int, num_actions: int, check_range: bool
) -> None:
    """Raise if actions are not integers [num_envs], or, where ``check_range`` is true, beyond
    ``num_actions``.
    """
    check_tensor(action, "action")
    unsigned = _UNSIGNED.get(action.dtype)
    if unsigned is None:
        raise TypeError(f"action has dtype {action.dtype}, expected integers such as torch.int64")
    shape = (num_envs,)
    if action.shape != shape:
        raise ValueError(
            f"action has shape {tuple(action.shape)}, expected {shape}, one integer an env"
        )
    # Seen as unsigned, negative numbers are large: one comparison finds both kinds of error.
    if check_range and action.cpu().numpy().view(unsigned).max() >= num_actions:
        lowest = int(action.min())
        highest = int(action.max())
        raise ValueError(
            f"actions range from {lowest} to {highest}, allowed: 0 to {num_actions - 1}"
        )


def check_one_hot(action: torch.Tensor, shape: tuple[int, int], check_values: bool) -> None:
    """Raise if actions are not of a shape, or, where ``check_values`` is true, unless every row,
    rounded (a softmax may miss the 1), holds a single one among zeros.
    """
    check_tensor(action, "action")
    if action.shape != shape:
        raise ValueError(f"action has shape {tuple(action.shape)}, expected one-hot {shape}")
    if not check_values:
        return
    rounded = action.to(torch.float32).round()
    ones = (rounded == 1).sum(-1)
    others = ((rounded != 0) & (rounded != 1)).any(-1)
    wrong = (ones != 1) | others
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0, 0])
        raise ValueError(
            f"action of env {row} is {action[row].tolist()}, expected one-hot: a single 1 among "
            "zeros"
        )


def check_merge(td: TensorDictBase, root: TensorDictBase) -> None:
    """Raise if entries of ``td`` cannot stay where they are while other envs are reset or stepped,
    giving ``root``.
    """
    # TorchRL merges all of them, also those that reset does not know
    for key, kept in td.items(True, True):
        if isinstance(kept, torch.Tensor):
            check_tensor(kept, f"entry {key!r}")
    for key, fresh in root.items():
        kept = td.get(key, None)
        if kept is not None and (
            isinstance(kept, torch.Tensor) != isinstance(fresh, torch.Tensor)
            or kept.shape != fresh.shape
        ):
            arrived = f"{type(kept).__name__} {list(kept.shape)}"
            raise ValueError(
                f"entry {key!r} is a {arrived}, expected shape {list(fresh.shape)} as the env "
                "gives it"
            )


def lacks_entries(td: TensorDictBase, following: TensorDictBase) -> bool:
    """Whether a root lacks something that ``"next"`` has, beside the reward."""
    return bool(set(following.keys()) - set(td.keys()) - {"reward"})


def fill_up(td: TensorDictBase, root: TensorDictBase) -> None:
    """Add the entries that ``td`` lacks, before TorchRL merges it with ``root``, the live episodes:
    it would put zeros in their place.
    """
    for key in root.keys(True, True):
        if td.get(key, None) is None:
            td.set(key, root[key])


def keep_what_was_written(td: TensorDictBase, following: TensorDictBase) -> None:
    """Add what the policy wrote for the next step, such as its recurrent state, to the ``"next"``
    that the env gives; say so if it ends there, since no spec of the env names it.
    """
    written = td.get("next", None)
    if written is None:
        return
    unknown = written.exclude(*following.keys(True, True))
    following.update(unknown)
    keys = unknown.keys(True, True)
    if keys:
        warn_state_is_dropped(*sorted(keys, key=str))


def saved_state(state: Mapping[str, Any], num_envs: int, device: torch.device | None) -> TensorDict:
    """A saved state as TensorDict [num_envs]; raises ValueError if it is of another size."""
    for name, value in state.items():
        if isinstance(value, torch.Tensor) and len(value) != num_envs:
            raise ValueError(
                f"the saved entry {name!r} is of {len(value)} envs, this env has {num_envs}"
            )
    return TensorDict(dict(state), batch_size=[num_envs], device=device)


def saved_ends(
    state: TensorDictBase, num_envs: int, device: torch.device | None
) -> torch.Tensor | None:
    """Which episodes of a snapshot have ended, bool [num_envs, 2], a copy; None: none of them, nor
    of the snapshots of version 0.2.0. Raises ValueError if the entry is something else.
    """
    ends = state.get("ends", None)
    if ends is None:
        return None
    check_tensor(ends, "state entry 'ends'")
    if ends.dtype is not torch.bool or ends.shape != (num_envs, 2):
        raise ValueError(
            f"state entry 'ends' is {ends.dtype} {list(ends.shape)}, expected torch.bool "
            f"[{num_envs}, 2]"
        )
    copied: torch.Tensor = ends.to(device, copy=True)
    return copied if copied.any() else None


def only_marked(
    td: TensorDictBase, following: TensorDictBase, marked: torch.Tensor
) -> TensorDictBase:
    """The ``"next"`` of a step that only some envs take, ``marked`` bool [N]: that of the others
    repeats their root ``td``, with the reward 0.
    """
    left_alone = following.apply(torch.zeros_like)
    # an old reward is not earned again
    kept = (key for key in following.keys(True, True) if key != "reward")
    left_alone.update(td.select(*kept, strict=False))
    merged: TensorDictBase = following.where(marked, left_alone)
    return merged


@functools.cache
def warn_state_is_dropped(*keys: NestedKey) -> None:
    """Say once that what a policy wrote for the next step does not get there: TorchRL carries what
    specs name.
    """
    names = ", ".join(".".join((key,) if isinstance(key, str) else key) for key in keys)
    warn(
        f"the policy wrote {names} for the next step, which does not get there, so a memory "
        "forgets: act in TransformedEnv(env, get_primers_from_module(policy)), or with "
        "ArcadeCollector"
    )


def mask(td: TensorDictBase, key: str, num_envs: int) -> torch.Tensor:
    """The entry ``"_reset"`` or ``"_step"`` as bool [num_envs]; raises if it is something else."""
    value = tensor(td, key)
    if value.dtype is not torch.bool:
        raise TypeError(f"entry {key!r} has dtype {value.dtype}, expected torch.bool")
    if value.shape not in ((num_envs,), (num_envs, 1)):
        raise ValueError(
            f"entry {key!r} has shape {tuple(value.shape)}, expected ({num_envs}, 1), one flag an "
            "env"
        )
    return value.reshape(num_envs)
