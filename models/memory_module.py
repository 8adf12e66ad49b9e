"""A memory model in place of TorchRL's ``LSTMModule``."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import unravel_key
from torch import nn

from arcade_torch.models.arguments import check_flags, check_keys
from arcade_torch.models.recurrence import Key, Recurrence, Store

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

__all__ = ["MemoryModule"]


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
        ValueError: unknown ``store``, "step" for a memory whose start is not zeros, or learned, or
            a key or a switch that is none.
        TypeError: the module is no memory model.

    Source: TorchRL's recurrent-state life cycle, ``LSTMModule`` and ``GRUModule``.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
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
        check_flags(default_recurrent_mode=default_recurrent_mode, check_sequences=check_sequences)
        check_keys(in_key=in_key, out_key=out_key, state_key=state_key, is_init_key=is_init_key)
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
