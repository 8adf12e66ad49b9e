"""What a memory notices of a batch that would make it learn or act from garbage in silence.

Two cases. In recurrent mode: steps that do not follow each other, as a sampler of single steps
gives them. In sequential mode: a step in mid-episode without a recurrent state, as an env gives it
that has no primer for one.
"""

import warnings
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = ["SequenceChecks"]

GUIDE = "docs/guides/torchrl.md"
STEPS_LOOKED_AT = 3
"""Calls without a state of which the flags are read on a GPU: after its first step a rollout is in
mid-episode."""


class SequenceChecks:
    """Looks at the batches that a memory reads; see :class:`MemoryModule`.

    To look is to wait for the device. So on a GPU it looks at the first batch of each shape, on a
    CPU at all, and nowhere inside of ``torch.compile``, ``vmap`` or a CUDA graph.

    Args:
        enabled: whether it looks at all.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled
        self._shapes: set[tuple[int, ...]] = set()
        self._steps_without_state = 0
        self._has_warned = False

    def check_order(self, tensordict: TensorDictBase, is_init: Tensor) -> None:
        """Refuse sequences whose steps do not follow each other, as far as the batch tells.

        Args:
            tensordict: [*, T]; ``step_count`` and ``("collector", "traj_ids")`` are looked at where
                they are. Steps that a ``mask`` leaves out may be anything.
            is_init: bool [*, T].

        Raises:
            ValueError: ``step_count`` does not go up by one, or the trajectory changes, where
                ``is_init`` is false.
        """
        if not self.enabled or not _may_wait(is_init) or is_init.shape[-1] < 2:
            return
        if not _is_host(is_init):
            if is_init.shape in self._shapes:
                return
            self._shapes.add(tuple(is_init.shape))
        goes_on = ~is_init[..., 1:] & _no_ends(tensordict, is_init.shape)
        for name, (numbers, follows) in _numbers(tensordict, is_init.shape).items():
            jumps = goes_on & ~follows
            if _any(jumps):
                before = int(numbers[..., :-1][jumps][0])
                after = int(numbers[..., 1:][jumps][0])
                raise ValueError(
                    f"{name} goes from {before} to {after} where is_init is false: a memory reads "
                    "whole windows [N, T], or slices of episodes (SliceSampler in a "
                    f"TensorDictReplayBuffer), never shuffled or cut steps; see {GUIDE}"
                    "#shuffled-steps. MemoryModule(..., check_sequences=False) reads them anyway"
                )

    def check_state(
        self, tensordict: TensorDictBase, is_init: Tensor, state_keys: Sequence[tuple[str, ...]]
    ) -> None:
        """Warn once of a step in mid-episode that has no recurrent state, so that the memory begins
        anew at it.

        Args:
            tensordict: [*batch], steps.
            is_init: bool [*batch].
            state_keys: where the state should stand.
        """
        if not self.enabled or self._has_warned or not _may_wait(is_init):
            return
        if any(key in tensordict for key in state_keys):
            return
        if not _is_host(is_init):
            self._steps_without_state += 1
            if self._steps_without_state > STEPS_LOOKED_AT:
                return
        if _any(~is_init):
            self._has_warned = True
            warnings.warn(
                f"no recurrent state {'.'.join(state_keys[0])!r} at a step whose is_init is false, "
                "so the memory begins anew at every step: act in TransformedEnv(env, "
                "get_primers_from_module(policy)), or with ArcadeCollector; for sequences, switch "
                f"set_recurrent_mode(True) on. See {GUIDE}#recurrent-policies",
                stacklevel=2,
            )


def _is_host(flags: Tensor) -> bool:
    return flags.device.type == "cpu"


def _may_wait(flags: Tensor) -> bool:
    """Whether values may be read: not while a program is made of the calls."""
    if torch.compiler.is_compiling():
        return False
    return not (flags.is_cuda and torch.cuda.is_current_stream_capturing())


def _any(flags: Tensor) -> bool:
    """Whether a flag is set; False where flags have no values to read (``vmap``, fake tensors)."""
    try:
        return bool(flags.any())
    except RuntimeError:
        return False


def _no_ends(tensordict: TensorDictBase, shape: torch.Size) -> Tensor | bool:
    """Where no end lies between a step and the one before, bool [*, T - 1], whatever ``is_init``
    says: none of an episode, and none of the steps, behind which zeros fill a row up.

    TorchRL's losses read next observations with the flags of the steps that led there: ``done`` at
    an end, and ``is_init`` false behind it.
    """
    goes_on: Tensor | bool = True
    done = _entry(tensordict, "done", shape)
    if done is not None:
        goes_on = ~done[..., :-1]
    for key in ("mask", ("collector", "mask")):
        mask = _entry(tensordict, key, shape)
        if mask is not None and mask.dtype == torch.bool:
            goes_on = goes_on & mask[..., 1:] & mask[..., :-1]
    return goes_on


def _numbers(tensordict: TensorDictBase, shape: torch.Size) -> dict[str, tuple[Tensor, Tensor]]:
    """What numbers the steps, [*, T], and where each follows the one before, bool [*, T - 1]."""
    numbers = {}
    count = _entry(tensordict, "step_count", shape)
    if count is not None:
        # an env that repeats actions counts several steps at once, and says so here
        after = _entry(tensordict, ("next", "step_count"), shape)
        expected = count[..., :-1] + 1 if after is None else after[..., :-1]
        numbers["step_count"] = (count, count[..., 1:] == expected)
    trajectory = _entry(tensordict, ("collector", "traj_ids"), shape)
    if trajectory is not None:
        follows = trajectory[..., 1:] == trajectory[..., :-1]
        numbers["('collector', 'traj_ids')"] = (trajectory, follows)
    return numbers


def _entry(
    tensordict: TensorDictBase, key: str | tuple[str, ...], shape: torch.Size
) -> Tensor | None:
    """An entry [*, T], with or without a last dimension of one; None if it is not there, or
    something else.
    """
    value = tensordict.get(key, None)
    if not isinstance(value, Tensor):
        return None
    if value.shape == (*shape, 1):
        value = value.squeeze(-1)
    return value if value.shape == shape else None
