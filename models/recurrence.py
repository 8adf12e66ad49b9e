"""How a memory reads a TensorDict: where its state stands, in which mode it reads, and whether the
steps of the batch follow each other.
"""

import logging
import multiprocessing
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor, nn

from arcade_torch.models.memory import first_state, replay, step_mask

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

__all__ = ["Key", "Recurrence", "SequenceChecks", "Store"]

Key = str | tuple[str, ...]
Store = Literal["step", "sequence"]

# bytes: what a frame of 128 x 128 pixels takes, beside which a state would be stored
LARGE_STATE = 49_152
GUIDE = "docs/guides/torchrl.md"
STEPS_LOOKED_AT = 3
"""Calls without a state of which the flags are read on a GPU: after its first step a rollout is in
mid-episode."""


class Recurrence:
    """Where the recurrent state of a memory stands in a TensorDict, and how the memory reads it.

    The part that :class:`MemoryModule` and ``MemoryNetwork`` share. It holds keys and modes but no
    module: the memory is an argument, so that its weights are registered in one place.

    Args:
        memory: a memory model; asked once what its state looks like.
        state_key: the keys of the state begin with it.
        is_init_key: start flags, bool [*batch, 1].
        default_recurrent_mode: mode outside of ``set_recurrent_mode``.
        store: see :class:`MemoryModule`.

    Attributes:
        state_keys: keys of the tensors of the state, without "next".
        next_state_keys: the same under "next".
        checks: what looks at the batches.

    Raises:
        ValueError: unknown ``store``, or "step" for a memory whose start is not zeros, or learned.
        TypeError: the module is no memory model.
    """

    def __init__(
        self,
        memory: nn.Module,
        state_key: Key,
        is_init_key: Key = "is_init",
        default_recurrent_mode: bool = False,
        store: Store | None = None,
    ) -> None:
        if store not in (None, "step", "sequence"):
            raise ValueError(f"store must be 'step', 'sequence' or None, got {store!r}")
        self.is_init_key = unravel_key(is_init_key)
        self.default_recurrent_mode = default_recurrent_mode
        prefix = (state_key,) if isinstance(state_key, str) else tuple(state_key)
        example = first_state(memory, 1)
        tensors = _tensors(example)
        self._paths = {(*prefix, *path): path for path in tensors}
        self._empty = _empty_nodes(example)
        self.state_keys = list(self._paths)
        self.next_state_keys = [("next", *key) for key in self.state_keys]
        begins_with_zeros = not any(_is_learned_or_not_zero(x) for x in tensors.values())
        if store == "step" and not begins_with_zeros:
            raise ValueError(
                "store='step' needs a memory that begins with zeros and learns no start: take "
                "'sequence'"
            )
        if store is None:
            state_bytes = sum(x.nbytes for x in tensors.values())
            small = begins_with_zeros and state_bytes <= LARGE_STATE
            store = "step" if small else "sequence"
        self.store: Store = store
        self.checks = SequenceChecks()

    @property
    def recurrent_mode(self) -> bool:
        """Whether the last batch dimension is read as time."""
        # late: a second to import, for those who want a memory alone
        from torchrl.modules import recurrent_mode

        mode = recurrent_mode()
        return self.default_recurrent_mode if mode is None else bool(mode)

    def start_flags(self, tensordict: TensorDictBase) -> Tensor:
        """The start flags of a tensordict, bool [*batch], whatever their type.

        Raises:
            ValueError: they are not [*batch, 1].
            KeyError: there are none.
        """
        shape = tensordict.batch_size
        is_init = tensordict.get(self.is_init_key, None)
        if is_init is None:
            raise KeyError(
                f"no {self.is_init_key!r} in the tensordict: append InitTracker() to the env"
            )
        if is_init.shape != (*shape, 1):
            raise ValueError(
                f"{self.is_init_key!r} must be bool {[*shape, 1]}, got {list(is_init.shape)}"
            )
        return is_init.squeeze(-1).bool()  # type: ignore[no-any-return]

    def read(self, memory: nn.Module, tensordict: TensorDictBase, x: Tensor) -> Tensor:
        """Let a memory read steps, or in recurrent mode sequences.

        Autocast is off inside: a recurrence adds up what bfloat16 rounds away.

        Args:
            memory: the memory model.
            tensordict: start flags and states are read from it, next states are written to it.
            x: float [*batch, D].

        Returns:
            float [*batch, H].
        """
        shape = tensordict.batch_size
        is_init = self.start_flags(tensordict)
        recurrent = self.recurrent_mode
        if recurrent and not shape:
            raise ValueError(
                "recurrent mode reads the last batch dimension as time, but the batch shape is []"
            )
        if self.state_keys and recurrent:
            self.checks.check_order(tensordict, is_init)
        elif self.state_keys:
            self.checks.check_state(tensordict, is_init, self.state_keys)
        # [B, T] in recurrent mode, else [B], whatever the batch dimensions of the tensordict
        flat = (shape[:-1].numel(), shape[-1]) if recurrent else (shape.numel(),)
        if x.ndim == 0 or x.shape[:-1].numel() != shape.numel():
            raise ValueError(
                f"x is {list(x.shape)} in a batch of shape {list(shape)}, expected one vector a "
                "step: flatten pictures, and give several agents a batch dimension"
            )
        x = x.reshape(*flat, x.shape[-1])
        is_init = is_init.reshape(flat)
        in_full: AbstractContextManager[object] = nullcontext()
        if not x.is_meta:  # it knows no autocast
            in_full = torch.autocast(x.device.type, enabled=False)
            if torch.is_autocast_enabled(x.device.type):
                x = x.float()

        with in_full:
            if not recurrent:
                state = self._stored_state(memory, tensordict, flat)
                y, after = memory(x.unsqueeze(1), state, is_init.unsqueeze(1))
            elif self.store == "step":
                states = self._stored_state(memory, tensordict, flat)
                y, after = replay(memory, x, states, is_init)
            else:
                first_step = tensordict.select(*self.state_keys, strict=False)[..., 0]
                state = self._stored_state(memory, first_step, flat[:1])
                y, after = memory(x, state, is_init)

        writes_states = not recurrent or self.store == "step"
        if writes_states:
            for key, path in self._paths.items():
                value = after.get(path)
                of_one = value.shape[len(flat) :]
                # as a tuple: of one env without a batch, a state that is a number has shape []
                tensordict.set(("next", *key), value.reshape((*shape, *of_one)))
        return y.reshape(*shape, y.shape[-1])  # type: ignore[no-any-return]

    def make_primer(self, memory: nn.Module) -> "TensorDictPrimer":
        """The transform that puts a memory's initial states into an env's resets."""
        from torchrl.data import Composite, Unbounded
        from torchrl.envs import TensorDictPrimer

        example = memory.initial_state(1)  # type: ignore[operator]
        primers = Composite()
        for key, path in self._paths.items():
            value = example.get(path)
            primers[key] = Unbounded(shape=value.shape[1:], dtype=value.dtype)
        return TensorDictPrimer(primers, expand_specs=True)

    def _stored_state(
        self, memory: nn.Module, tensordict: TensorDictBase, flat: tuple[int, ...]
    ) -> TensorDict:
        """The states in a tensordict, with the batch shape ``flat``, [B] or [B, T]; the initial
        state where one is missing.
        """
        state = TensorDict({}, batch_size=flat)
        for key, path in self._paths.items():
            value = tensordict.get(key, None)
            if value is not None:
                value = value.reshape(*flat, *value.shape[tensordict.ndim :])
            else:
                value = memory.initial_state(flat[0]).get(path)  # type: ignore[operator]
                if len(flat) == 2:
                    value = value.unsqueeze(1).expand(*flat, *value.shape[1:])
            state.set(path, value)
        for path in self._empty:
            state.set(path, TensorDict({}, batch_size=flat))
        return state


class SequenceChecks:
    """What a memory notices of a batch that would make it learn or act from garbage in silence.

    Two cases. In recurrent mode: steps that do not follow each other, as a sampler of single steps
    gives them. In sequential mode: a step in mid-episode without a recurrent state, as an env gives
    it that has no primer for one.

    To look is to wait for the device. So on a GPU it looks at the first batch of each shape, on a
    CPU at all, and nowhere inside of ``torch.compile``, ``vmap`` or a CUDA graph.

    Attributes:
        enabled: whether it looks at all.
    """

    def __init__(self) -> None:
        self.enabled = True
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
            _warn(
                f"no recurrent state {'.'.join(state_keys[0])!r} at a step whose is_init is false, "
                "so the memory begins anew at every step: act in TransformedEnv(env, "
                "get_primers_from_module(policy)), or with ArcadeCollector; for sequences, switch "
                f"set_recurrent_mode(True) on. See {GUIDE}#recurrent-policies"
            )


def _tensors(state: TensorDictBase) -> dict[tuple[str, ...], Tensor]:
    """The tensors of a state by path."""
    tensors = {}
    for key, value in state.items(True, True):
        tensors[(key,) if isinstance(key, str) else tuple(key)] = value
    return tensors


def _is_learned_or_not_zero(start: Tensor) -> bool:
    """Whether a tensor of the first state is learned or has an entry that is not 0; one without
    data (on the meta device) has none.
    """
    return start.requires_grad or (not start.is_meta and bool(start.any()))


def _empty_nodes(state: TensorDictBase) -> list[tuple[str, ...]]:
    """Paths of nested TensorDicts without any tensor, as layers without a state have."""
    empty = []
    for key, value in state.items(True, False):
        if isinstance(value, TensorDictBase) and value.is_empty():
            empty.append((key,) if isinstance(key, str) else tuple(key))
    return empty


def _warn(says: str) -> None:
    """Warn; in a worker by a line of the log, for there TorchRL silences warnings."""
    if multiprocessing.parent_process() is not None:
        logging.getLogger(__name__).warning(says)
    else:
        warnings.warn(says, stacklevel=3)


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
    mask = step_mask(tensordict, shape)
    if mask is not None:
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
