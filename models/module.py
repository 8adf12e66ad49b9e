"""Memory models behind TorchRL's recurrent contract: put one where an ``LSTMModule`` was and change nothing else."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

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

    Args:
        memory: a memory model (``MemoryContract``).
        in_key: features, float [*batch, D].
        out_key: output, float [*batch, H].
        state_key: where the recurrent state stands; give actor and critic different ones.
        is_init_key: start flags, bool [*batch, 1].
        default_recurrent_mode: mode outside of ``set_recurrent_mode``.

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
    ) -> None:
        super().__init__()
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
            the same object, with ``out_keys``.

        Raises:
            ValueError: recurrent mode without a time dimension, or start flags that are not [*batch, 1].
        """
        shape = tensordict.batch_size
        is_init = tensordict.get(self.is_init_key)
        if is_init.shape != (*shape, 1):
            raise ValueError(f"{self.is_init_key!r} must be bool {[*shape, 1]}, got {list(is_init.shape)}")
        if not self.recurrent_mode:
            rows: tuple[int, ...] = (shape.numel(),)
        elif not shape:
            raise ValueError("recurrent mode reads the last batch dimension as time, but the batch shape is []")
        else:
            rows = (shape[:-1].numel(), shape[-1])
        x = tensordict.get(self.in_key)
        x, is_init = x.reshape(*rows, x.shape[-1]), is_init.reshape(rows)
        state = self._stored_state(tensordict, rows)
        if len(rows) == 2:
            y, after = replay(self.memory, x, state, is_init)
        else:
            y, after = self.memory(x.unsqueeze(1), state, is_init.unsqueeze(1))
        tensordict.set(self.out_key, y.reshape(*shape, y.shape[-1]))
        for key, leaf in self._state_keys.items():
            value = after.get(leaf)
            tensordict.set(("next", *key), value.reshape(*shape, *value.shape[len(rows) :]))
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
