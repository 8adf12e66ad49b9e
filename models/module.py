"""Memory models behind TorchRL's recurrent contract: put one where an ``LSTMModule`` was and change nothing else."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.modules import recurrent_mode

from arcade_torch.models.base import replay

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

__all__ = ["MemoryModule"]

Key = str | tuple[str, ...]

LARGE_STATE = 49_152  # bytes: what a frame of 128 x 128 pixels takes, beside which a state would be stored


class MemoryModule(TensorDictModuleBase):
    """A memory model as a TensorDict module with the keys and modes of TorchRL's ``LSTMModule``.

    It reads ``[in_key, state keys, is_init]`` and writes ``[out_key, ("next", state keys)]``; a state key is
    ``state_key`` followed by the path of the tensor in the model's state, such as ``("memory", "h")``.

    * *Sequential* mode (the default; collecting): every element of the batch is one step; the state is the initial one
      where ``is_init`` is set.
    * *Recurrent* mode (``with set_recurrent_mode(True)``; losses switch it on by themselves, GAE called on its own does
      not): the last batch dimension is time. Sequences start from the state stored at index 0, and at every later
      ``is_init`` from the state stored *there*: zeros after a true reset, because the primer put them there, and the
      true state where a sampler cut an episode. Returns the output and the state of every step.

    States larger than a frame (the window of a transformer: 0.5 MB a step and layer) are never wanted for every step.
    With ``store="sequence"`` recurrent mode looks at the state at index 0 only, begins afresh at every ``is_init`` (at
    index 0 too), and writes no states. Collect with ``ArcadeCollector(..., store_states=False)`` and hand its
    ``initial_state`` over with :meth:`begin_with`; TorchRL's own ``Collector`` stacks whatever a policy carries. A
    slice that a sampler cut out of an episode then begins with an empty memory. TorchRL's ``GAE`` reads next states, or
    with ``shifted=True`` calls the observation after an episode's first step a start as well (it matters where a window
    ends or is truncated there): better give it values of your own, from one pass over the frames of the window and the
    one after it.

    Args:
        memory: a memory model (``MemoryContract``).
        in_key: features, float [*batch, D].
        out_key: output, float [*batch, H].
        state_key: where the recurrent state stands; give actor and critic different ones.
        is_init_key: start flags, bool [*batch, 1].
        default_recurrent_mode: mode outside of ``set_recurrent_mode``.
        store: "step": a stored sequence holds the state of every step; "sequence": that of its first step; None: "step"
            unless one state takes more than 49,152 bytes, the size of a frame.

    Raises:
        ValueError: unknown ``store``.

    Source: TorchRL's recurrent-state life cycle, ``LSTMModule`` and ``GRUModule``.

    Example:
        >>> import torch
        >>> from arcade_torch.models import make_memory
        >>> from torchrl.modules import set_recurrent_mode
        >>> module = MemoryModule(make_memory("mingru", 3, 4), in_key="features", out_key="remembered")
        >>> module.in_keys, module.out_keys
        (['features', ('memory', 'h'), 'is_init'], ['remembered', ('next', 'memory', 'h')])
        >>> flags = torch.zeros(2, 1, dtype=torch.bool)
        >>> step = module(TensorDict({"features": torch.ones(2, 3), "is_init": flags}, [2]))
        >>> step["remembered"].shape, step["next", "memory", "h"].shape
        (torch.Size([2, 4]), torch.Size([2, 4]))
        >>> sequence = TensorDict({"features": torch.ones(2, 5, 3), "is_init": flags.expand(2, 5)[..., None]}, [2, 5])
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
        store: Literal["step", "sequence"] | None = None,
    ) -> None:
        super().__init__()
        if store not in (None, "step", "sequence"):
            raise ValueError(f"store must be 'step', 'sequence' or None, got {store!r}")
        self.memory = memory
        self.in_key, self.out_key = unravel_key(in_key), unravel_key(out_key)
        self.is_init_key = unravel_key(is_init_key)
        self.default_recurrent_mode = default_recurrent_mode
        prefix = (state_key,) if isinstance(state_key, str) else tuple(state_key)
        example = memory.initial_state(1)  # type: ignore[operator]
        paths = [(key,) if isinstance(key, str) else tuple(key) for key in example.keys(True, False)]
        leaves = [path for path in paths if isinstance(example.get(path), Tensor)]
        self._empty = [p for p in paths if p not in leaves and not any(leaf[: len(p)] == p for leaf in leaves)]
        self._state_keys = {(*prefix, *leaf): leaf for leaf in leaves}
        state_bytes = sum(example.get(leaf).nbytes for leaf in leaves)
        self.store = store or ("step" if state_bytes <= LARGE_STATE else "sequence")
        self.in_keys = [self.in_key, *self._state_keys, self.is_init_key]
        self.out_keys = [self.out_key, *(("next", *key) for key in self._state_keys)]

    @property
    def recurrent_mode(self) -> bool:
        """Whether the last batch dimension is read as time."""
        mode = recurrent_mode()
        return self.default_recurrent_mode if mode is None else bool(mode)

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Read one step, or in recurrent mode sequences, and write output and next state.

        Args:
            tensordict: any batch shape (in recurrent mode [*, T]; [T] alone is one sequence) with ``in_keys``; state
                keys may be missing, which means the initial state.

        Returns:
            the same object, with ``out_keys`` (in recurrent mode with ``store="sequence"``: ``out_key`` only).

        Raises:
            ValueError: recurrent mode without a time dimension, or start flags that are not [*batch, 1].
            KeyError: no start flags.
        """
        shape = tensordict.batch_size
        is_init = tensordict.get(self.is_init_key, None)
        if is_init is None:
            raise KeyError(f"no {self.is_init_key!r} in the tensordict: append InitTracker() to the env")
        if is_init.shape != (*shape, 1):
            raise ValueError(f"{self.is_init_key!r} must be bool {[*shape, 1]}, got {list(is_init.shape)}")
        recurrent = self.recurrent_mode
        if recurrent and not shape:
            raise ValueError("recurrent mode reads the last batch dimension as time, but the batch shape is []")
        rows = (shape[:-1].numel(), shape[-1]) if recurrent else (shape.numel(),)
        x = tensordict.get(self.in_key)
        x, is_init = x.reshape(*rows, x.shape[-1]), is_init.reshape(rows)
        if not recurrent:
            y, after = self.memory(x.unsqueeze(1), self._stored_state(tensordict, rows), is_init.unsqueeze(1))
        elif self.store == "step":
            y, after = replay(self.memory, x, self._stored_state(tensordict, rows), is_init)
        else:
            y, after = self._read_sequences(tensordict, x, is_init)
        tensordict.set(self.out_key, y.reshape(*shape, y.shape[-1]))
        for key, leaf in self._state_keys.items():
            if recurrent and self.store == "sequence":
                break
            value = after.get(leaf)
            tensordict.set(("next", *key), value.reshape(*shape, *value.shape[len(rows) :]))
        return tensordict

    def _read_sequences(self, tensordict: TensorDictBase, x: Tensor, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Read sequences [B, T] from the states at index 0."""
        firsts = tensordict.select(*self._state_keys, strict=False)[..., 0]
        return self.memory(x, self._stored_state(firsts, x.shape[:1]), is_init)  # type: ignore[no-any-return]

    def begin_with(self, tensordict: TensorDictBase, state: TensorDictBase) -> TensorDictBase:
        """Let sequences begin with states that were stored once each.

        Args:
            tensordict: [*batch, T], sequences.
            state: [*batch] with ``state_keys``, the states before index 0, such as the ``initial_state`` that
                ``ArcadeCollector.collect`` returns.

        Returns:
            ``tensordict``, with the state keys; a view that takes no memory, of which only index 0 counts.

        Raises:
            ValueError: ``store`` is "step": later starts would load the state of index 0.
            KeyError: ``state`` lacks a state key.
        """
        if self.store == "step":
            raise ValueError("with store='step' every step needs a state of its own: make the module with 'sequence'")
        for key in self._state_keys:
            value = state.get(key)
            axis = tensordict.ndim - 1
            wide = (*value.shape[:axis], tensordict.shape[-1], *value.shape[axis:])
            tensordict.set(key, value.unsqueeze(axis).expand(wide))
        return tensordict

    def _stored_state(self, tensordict: TensorDictBase, rows: tuple[int, ...]) -> TensorDict:
        """The states at hand, with the batch shape of ``rows``; where one is missing, the initial state."""
        initial = None
        state = TensorDict({}, batch_size=rows)
        for key, leaf in self._state_keys.items():
            value = tensordict.get(key, None)
            if value is None:
                if initial is None:
                    initial = self.memory.initial_state(rows[0])  # type: ignore[operator]
                value = initial.get(leaf)
                value = value if len(rows) == 1 else value.unsqueeze(1).expand(*rows, *value.shape[1:])
            else:
                value = value.reshape(*rows, *value.shape[tensordict.ndim :])
            state.set(leaf, value)
        for path in self._empty:
            state.set(path, TensorDict({}, batch_size=rows))
        return state

    def make_tensordict_primer(self) -> "TensorDictPrimer":
        """The transform that puts initial states into an env's resets; ``get_primers_from_module`` finds it.

        Returns:
            ``TensorDictPrimer`` for the state keys, zeros (a state that starts elsewhere is restored by the memory, at
            ``is_init``).
        """
        from torchrl.envs import TensorDictPrimer

        example = self.memory.initial_state(1)  # type: ignore[operator]
        primers = Composite()
        for key, leaf in self._state_keys.items():
            value = example.get(leaf)
            primers[key] = Unbounded(shape=value.shape[1:], dtype=value.dtype)
        return TensorDictPrimer(primers, expand_specs=True)

    def extra_repr(self) -> str:
        """Keys, for printing."""
        return f"in_keys={self.in_keys}, out_keys={self.out_keys}"

    @property
    def state_keys(self) -> Sequence[tuple[str, ...]]:
        """Keys of the recurrent state, without "next"."""
        return list(self._state_keys)
