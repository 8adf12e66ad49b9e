"""What a memory model is: two methods, the shared half of ours, and how TorchRL sees one
(:class:`MemoryModule`).
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import unravel_key
from torch import Tensor, nn

from arcade_torch.models.sequence_checks import SequenceChecks

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

__all__ = [
    "Key", "Memory", "MemoryContract", "MemoryModule", "Recurrence", "ReplayableMemory", "Store",
    "batch_shape", "replay", "replay_by_steps",
]  # fmt: skip

Key = str | tuple[str, ...]
Store = Literal["step", "sequence"]

# bytes: what a frame of 128 x 128 pixels takes, beside which a state would be stored
LARGE_STATE = 49_152


@runtime_checkable
class MemoryContract(Protocol):
    """The two methods by which any module, ours or yours, is a memory model; ``check_memory`` tests
    the laws.
    """

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Read a chunk of steps.

        Args:
            x: float [B, T, D], inputs; acting is the same call with T = 1.
            state: TensorDict [B] of fixed-shape tensors, the recurrent state before step 0.
            is_init: bool [B, T], True where a step opens an episode: everything before it is
                forgotten *before* that step is read (at index 0: ``state`` is ignored).

        Returns:
            (y float [B, T, H], state TensorDict [B] after the last step); the given state is not
            modified.
        """

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """The state at the start of an episode, TensorDict [batch_size]."""


@runtime_checkable
class ReplayableMemory(MemoryContract, Protocol):
    """A memory that also replays stored data at full speed; without this method :func:`replay`
    steps through time.
    """

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Read sequences whose every step carries the recurrent state that was stored when it was
        acted.

        Args:
            x: float [B, T, D].
            stored: TensorDict [B, T], the state *before* each step; loaded at index 0 and wherever
                ``is_init`` is set (zeros after a real reset, a real state where a sampler cut an
                episode), not looked at elsewhere.
            is_init: bool [B, T].

        Returns:
            (y float [B, T, H], states TensorDict [B, T] *after* each step).
        """


def replay(
    memory: nn.Module, x: Tensor, stored: TensorDict, is_init: Tensor
) -> tuple[Tensor, TensorDict]:
    """:meth:`ReplayableMemory.replay` of any memory: by its own method, or step by step where it
    has none.
    """
    if isinstance(memory, ReplayableMemory):
        return memory.replay(x, stored, is_init)
    return replay_by_steps(memory, x, stored, is_init)


def replay_by_steps(
    memory: Callable[..., tuple[Tensor, TensorDict]], x: Tensor, stored: TensorDict, is_init: Tensor
) -> tuple[Tensor, TensorDict]:
    """The same, one call a step (slow): what :func:`replay` falls back to, and the oracle of
    ``replay`` methods.
    """
    state = stored[:, 0]
    carried_on = torch.zeros_like(is_init[:, :1])
    outputs = []
    states = []
    for t in range(x.shape[1]):
        if t > 0:
            state = stored[:, t].where(is_init[:, t], state)
        y, state = memory(x[:, t : t + 1], state, carried_on)
        outputs.append(y)
        states.append(state)
    return torch.cat(outputs, dim=1), torch.stack(states, dim=1)


class Memory(nn.Module):
    """Base of the memory models of this package: sizes, initial state, and clear errors.

    A model whose state is one tensor ``"h"``, of which it can afford one per step, says what shape
    that has (``state_shape``, None for no state) and implements :meth:`run`. Others override
    :meth:`state_leaves`, ``forward`` and ``replay``.

    Args:
        input_size: D, features per step.
        hidden_size: H, features of the output.

    Raises:
        ValueError: a size is not positive.
    """

    state_shape: tuple[int, ...] | None = None
    averages_values = False
    """Whether every output is a function of the input and of a weighted mean over the episode's
    steps, as in softmax and linear attention; ``check_memory`` then has one more law."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        if input_size < 1 or hidden_size < 1:
            raise ValueError(
                f"sizes must be positive, got input_size={input_size}, hidden_size={hidden_size}"
            )
        self.input_size = input_size
        self.hidden_size = hidden_size
        self.register_buffer("like", torch.empty(0), persistent=False)
        self.like: Tensor
        """An empty tensor with the dtype and the device of the parameters, which a loss may have
        put elsewhere.
        """

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """Read a chunk of steps.

        Args:
            x: float [B, T, D].
            h0: [B, *state_shape], the state before step 0, or [B, T, *state_shape], one stored
                state per step (loaded at index 0 and wherever ``is_init`` is set).
            is_init: bool [B, T].

        Returns:
            (y [B, T, H], state after each step [B, T, *state_shape]).
        """
        raise NotImplementedError

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """Shape, without the batch, and dtype (None: that of the parameters) of every tensor in the
        state.
        """
        return {} if self.state_shape is None else {"h": (self.state_shape, None)}

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See :class:`MemoryContract`."""
        self._check(x, state, is_init)
        y, h = self.run(x, state["h"], is_init)
        # y may be the same memory
        return y, TensorDict({"h": h[:, -1].clone()}, batch_size=[x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See :class:`ReplayableMemory`."""
        self._check(x, stored, is_init, batch_ndim=2)
        y, h = self.run(x, stored["h"], is_init)
        return y, TensorDict({"h": h}, batch_size=x.shape[:2])

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """Zeros: TensorDict [batch_size] with :meth:`state_leaves`, in the parameters' dtype and on
        their device.
        """
        batch = batch_shape(batch_size)
        state = TensorDict({}, batch_size=batch)
        for name, (shape, dtype) in self.state_leaves().items():
            state[name] = torch.zeros(
                *batch, *shape, dtype=dtype or self.like.dtype, device=self.like.device
            )
        return state

    def _check(self, x: Tensor, state: TensorDict, is_init: Tensor, batch_ndim: int = 1) -> None:
        """Raise ValueError unless shapes and types are those of ``forward`` (``batch_ndim`` 1) or
        ``replay`` (2).
        """
        self._check_input(x)
        _check_start_flags(is_init, x)
        self._check_state(state, x.shape[:batch_ndim])

    def _check_input(self, x: Tensor) -> None:
        if x.ndim != 3 or x.shape[-1] != self.input_size:
            raise ValueError(
                f"x must be [B, T, {self.input_size}], got {list(x.shape)} (acting is T = 1)"
            )
        if x.shape[1] == 0:
            raise ValueError(f"x must have at least one step, got {list(x.shape)}")
        dtype = self.like.dtype
        if x.dtype != dtype:
            raise ValueError(
                f"x is {x.dtype} but the parameters are {dtype}: cast one of them with .to()"
            )
        if torch.is_autocast_enabled(x.device.type):
            raise ValueError(
                "memory models round too much under autocast: turn it off here, as MemoryModule "
                "does"
            )

    def _check_state(self, state: Any, batch: Sequence[int]) -> None:
        if not isinstance(state, TensorDictBase):
            raise ValueError(
                "the state must be a TensorDict, as from initial_state(batch_size), got "
                f"{type(state)}"
            )
        expected = {}
        for name, (shape, _) in self.state_leaves().items():
            expected[name] = [*batch, *shape]
        given = {}
        for name, leaf in state.items():
            given[name] = list(leaf.shape)
        if given != expected:
            raise ValueError(
                f"the state of {type(self).__name__} must be {expected}, got {given}: "
                "it belongs to another model or batch size; begin with initial_state(batch_size)"
            )

    def extra_repr(self) -> str:
        """Sizes, for printing."""
        return f"input_size={self.input_size}, hidden_size={self.hidden_size}"


def _check_start_flags(is_init: Any, x: Tensor) -> None:
    """Raise ValueError unless start flags are bool [B, T]."""
    expected = list(x.shape[:2])
    if not isinstance(is_init, Tensor):
        given = repr(is_init)
    elif is_init.dtype != torch.bool or list(is_init.shape) != expected:
        given = f"{is_init.dtype} {list(is_init.shape)}"
    else:
        return
    raise ValueError(
        f"is_init must be bool [B, T] = {expected}, got {given}; [B, T, 1] needs squeeze(-1)"
    )


class MemoryModule(TensorDictModuleBase):
    """A memory model as a TensorDict module with the keys and modes of TorchRL's ``LSTMModule``.

    It reads ``[in_key, state keys, is_init]`` and writes ``[out_key, ("next", state keys)]``; a
    state key is ``state_key`` followed by the path of the tensor in the model's state, such as
    ``("memory", "h")``.

    * *Sequential* mode (the default; collecting): every element of the batch is one step; the state
      is the initial one where ``is_init`` is set.
    * *Recurrent* mode (``with set_recurrent_mode(True)``; losses switch it on by themselves, GAE
      called on its own does not): the last batch dimension is time. Sequences start from the state
      stored at index 0, and at every later ``is_init`` from the state stored *there*: zeros after a
      true reset, because the primer put them there, and the true state where a sampler cut an
      episode. Returns the output and the state of every step.

    States larger than a frame (the window of a transformer: 0.5 MB a step and layer) are never
    wanted for every step. With ``store="sequence"`` recurrent mode looks at the state at index 0
    only, begins afresh at every ``is_init``, and writes no states: collect with
    ``ArcadeCollector(..., store_states=False)`` and hand its ``initial_state`` over with
    :meth:`begin_with`. TorchRL's ``GAE`` needs the state of every step; ``SequenceGAE`` of the
    agents does not.

    Args:
        memory: a memory model (``MemoryContract``).
        in_key: features, float [*batch, D].
        out_key: output, float [*batch, H].
        state_key: where the recurrent state stands; give actor and critic different ones.
        is_init_key: start flags, bool [*batch, 1].
        default_recurrent_mode: mode outside of ``set_recurrent_mode``.
        store: "step": a stored sequence holds the state of every step; "sequence": that of its
            first step; None: "step" unless a state takes more than 49,152 bytes, the size of a
            frame, or its start is not zeros, or learned.
        check_sequences: refuse shuffled or cut steps in recurrent mode, and warn of a missing
            recurrent state in sequential mode, where the batch shows it.

    Raises:
        ValueError: unknown ``store``, or "step" for a memory whose start is not zeros, or learned.

    Source: TorchRL's recurrent-state life cycle, ``LSTMModule`` and ``GRUModule``.

    Example:
        >>> from arcade_torch.models import make_memory
        >>> from torchrl.modules import set_recurrent_mode
        >>> memory = make_memory("mingru", 3, 4)
        >>> module = MemoryModule(memory, in_key="features", out_key="remembered")
        >>> module.in_keys, module.out_keys
        (['features', ('memory', 'h'), 'is_init'], ['remembered', ('next', 'memory', 'h')])
        >>> flags = torch.ones(2, 1, dtype=torch.bool)
        >>> step = TensorDict({"features": torch.ones(2, 3), "is_init": flags}, [2])
        >>> module(step)["next", "memory", "h"].shape
        torch.Size([2, 4])
        >>> flags = torch.zeros(2, 5, 1, dtype=torch.bool)
        >>> sequence = TensorDict({"features": torch.ones(2, 5, 3), "is_init": flags}, [2, 5])
        >>> with set_recurrent_mode(True):
        ...     module(sequence)["remembered"].shape
        torch.Size([2, 5, 4])
    """

    def __init__(
        self,
        memory: nn.Module,
        in_key: Key = "embed",
        out_key: Key = "embed_memory",
        state_key: Key = "memory",
        *,
        is_init_key: Key = "is_init",
        default_recurrent_mode: bool = False,
        store: Store | None = None,
        check_sequences: bool = True,
    ) -> None:
        super().__init__()
        self.memory = memory
        self.in_key = unravel_key(in_key)
        self.out_key = unravel_key(out_key)
        self.recurrence = Recurrence(memory, state_key, is_init_key, default_recurrent_mode, store)
        self.recurrence.checks.enabled = check_sequences
        self.is_init_key = self.recurrence.is_init_key
        self.store = self.recurrence.store
        self.in_keys = [self.in_key, *self.state_keys, self.is_init_key]
        self.out_keys = [self.out_key, *self.recurrence.next_state_keys]

    @property
    def recurrent_mode(self) -> bool:
        """Whether the last batch dimension is read as time."""
        return self.recurrence.recurrent_mode

    @property
    def default_recurrent_mode(self) -> bool:
        """The mode outside of ``set_recurrent_mode``."""
        return self.recurrence.default_recurrent_mode

    @property
    def state_keys(self) -> Sequence[tuple[str, ...]]:
        """Keys of the recurrent state, without "next"."""
        return self.recurrence.state_keys

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Read one step, or in recurrent mode sequences, and write output and next state.

        Args:
            tensordict: any batch shape (in recurrent mode [*, T]; [T] alone is one sequence) with
                ``in_keys``; state keys may be missing, which means the initial state.

        Returns:
            the same object, with ``out_keys`` (in recurrent mode with ``store="sequence"``:
            ``out_key`` only; so do not call it with keywords there).

        Raises:
            ValueError: recurrent mode without a time dimension, start flags that are not
                [*batch, 1], or steps that do not follow each other.
            KeyError: no input or no start flags.
        """
        y = self.recurrence.read(self.memory, tensordict, tensordict[self.in_key])
        tensordict.set(self.out_key, y)
        return tensordict

    def begin_with(self, tensordict: TensorDictBase, state: TensorDictBase) -> TensorDictBase:
        """Let sequences begin with states that were stored once each.

        Args:
            tensordict: [*batch, T], sequences.
            state: [*batch] with ``state_keys``, the states before index 0, such as the
                ``initial_state`` that ``ArcadeCollector.collect`` returns.

        Returns:
            ``tensordict``, with the state keys; a view that takes no memory, of which only index 0
            counts.

        Raises:
            ValueError: ``store`` is "step": later starts would load the state of index 0.
            KeyError: ``state`` lacks a state key.
        """
        if self.store == "step":
            raise ValueError(
                "with store='step' every step needs a state of its own: make the module with "
                "'sequence'"
            )
        for key in self.state_keys:
            value = state[key]
            axis = tensordict.ndim - 1
            shape = (*value.shape[:axis], tensordict.shape[-1], *value.shape[axis:])
            tensordict.set(key, value.unsqueeze(axis).expand(shape))
        return tensordict

    def make_tensordict_primer(self) -> "TensorDictPrimer":
        """The transform that puts initial states into an env's resets; ``get_primers_from_module``
        finds it.

        Returns:
            ``TensorDictPrimer`` for the state keys, zeros (a memory that begins elsewhere does so
            at ``is_init``).
        """
        return self.recurrence.make_primer(self.memory)


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
        example = memory.initial_state(1)  # type: ignore[operator]
        tensors = _tensors(example)
        self._paths = {(*prefix, *path): path for path in tensors}
        self._empty = _empty_nodes(example)
        self.state_keys = list(self._paths)
        self.next_state_keys = [("next", *key) for key in self.state_keys]
        begins_with_zeros = not any(x.any() or x.requires_grad for x in tensors.values())
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
        """The start flags of a tensordict, bool [*batch].

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
        return is_init.squeeze(-1)  # type: ignore[no-any-return]

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
        rows = (shape[:-1].numel(), shape[-1]) if recurrent else (shape.numel(),)
        x = x.reshape(*rows, x.shape[-1])
        is_init = is_init.reshape(rows)
        if torch.is_autocast_enabled(x.device.type):
            x = x.float()

        with torch.autocast(x.device.type, enabled=False):
            if not recurrent:
                state = self._stored_state(memory, tensordict, rows)
                y, after = memory(x.unsqueeze(1), state, is_init.unsqueeze(1))
            elif self.store == "step":
                states = self._stored_state(memory, tensordict, rows)
                y, after = replay(memory, x, states, is_init)
            else:
                first_step = tensordict.select(*self.state_keys, strict=False)[..., 0]
                state = self._stored_state(memory, first_step, rows[:1])
                y, after = memory(x, state, is_init)

        writes_states = not recurrent or self.store == "step"
        if writes_states:
            for key, path in self._paths.items():
                value = after.get(path)
                tensordict.set(("next", *key), value.reshape(*shape, *value.shape[len(rows) :]))
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
        self, memory: nn.Module, tensordict: TensorDictBase, rows: tuple[int, ...]
    ) -> TensorDict:
        """The states in a tensordict, with the batch shape ``rows``; the initial state where one is
        missing.
        """
        state = TensorDict({}, batch_size=rows)
        for key, path in self._paths.items():
            value = tensordict.get(key, None)
            if value is not None:
                value = value.reshape(*rows, *value.shape[tensordict.ndim :])
            else:
                value = memory.initial_state(rows[0]).get(path)  # type: ignore[operator]
                if len(rows) == 2:
                    value = value.unsqueeze(1).expand(*rows, *value.shape[1:])
            state.set(path, value)
        for path in self._empty:
            state.set(path, TensorDict({}, batch_size=rows))
        return state


def _tensors(state: TensorDictBase) -> dict[tuple[str, ...], Tensor]:
    """The tensors of a state by path."""
    tensors = {}
    for key, value in state.items(True, True):
        tensors[(key,) if isinstance(key, str) else tuple(key)] = value
    return tensors


def _empty_nodes(state: TensorDictBase) -> list[tuple[str, ...]]:
    """Paths of nested TensorDicts without any tensor, as layers without a state have."""
    empty = []
    for key, value in state.items(True, False):
        if isinstance(value, TensorDictBase) and value.is_empty():
            empty.append((key,) if isinstance(key, str) else tuple(key))
    return empty


def batch_shape(batch_size: int | Sequence[int]) -> list[int]:
    """A batch size, one number or several, as a list."""
    return [batch_size] if isinstance(batch_size, int) else list(batch_size)
