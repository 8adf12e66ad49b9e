"""``RecurrentMemory``: a recurrent module of any library as a memory model."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models.memory import Memory, batch_shape, replay_by_steps

__all__ = ["RecurrentMemory"]

Run = Callable[[nn.Module, Tensor, Any], tuple[Tensor, Any]]
Start = Callable[[nn.Module, int], Any]


class Leaf(NamedTuple):
    """A tensor of a module's state."""

    batch_axis: int
    shape: tuple[int, ...]  # without the batch
    dtype: torch.dtype | None  # None: that of the parameters


class RecurrentMemory(Memory):
    """A module that is called as ``y, state = module(x, state)``, as ``torch.nn.LSTM`` and many
    others are, with what such modules lack: starts of episodes in the middle of a sequence, and a
    state in a TensorDict.

    A sequence is cut wherever an episode of the batch begins, and the module is run once a piece;
    a GPU is waited for to find the cuts. Where every step has a stored state, it is run once a
    step. ``check_memory`` says whether the module keeps the laws of a memory: one that reads
    backwards too, or drops out, does not.

    Args:
        module: What it carries on is in its state: tensors, alone or in tuples, lists and
            dictionaries, whose shape does not depend on the steps that were read, each with an axis
            for the batch.
        input_size: D, features of an input step.
        hidden_size: H, features of an output step.
        run: How the module reads a chunk: ``(module, x [B, T, D], state) -> (y [B, T, H], state)``.
            None: ``module(x, state)``, with time as the first axis where ``module.batch_first`` is
            false.
        start: The state at the start of an episode, as the module has it: ``(module, batch size)
            -> state``. None: zeros, if that is what the module begins with when it is given None.

    Raises:
        TypeError: The module cannot be run so, or its state holds something that is no tensor.
        ValueError: Outputs of another size; a state that grows with the steps, has no axis for the
            batch, or begins with something else than zeros.

    Example:
        >>> from arcade_torch.models import check_memory, register_memory
        >>> def stacked(input_size, hidden_size):
        ...     module = nn.LSTM(input_size, hidden_size, num_layers=2)
        ...     return RecurrentMemory(module, input_size, hidden_size)
        >>> register_memory("stacked_lstm", stacked)
        >>> memory = stacked(4, 8)
        >>> {name: list(leaf.shape) for name, leaf in memory.initial_state(3).items()}
        {'0': [3, 2, 8], '1': [3, 2, 8]}
        >>> max(check_memory(memory).values()) < 1e-6
        True
    """

    def __init__(
        self,
        module: nn.Module,
        input_size: int,
        hidden_size: int,
        *,
        run: Run | None = None,
        start: Start | None = None,
    ) -> None:
        super().__init__(input_size, hidden_size)
        self.module = module
        self._read = _call if run is None else run
        self._start = start
        self._name = type(module).__name__
        floating = [weight for weight in module.parameters() if weight.is_floating_point()]
        if floating:
            self.like = floating[0].new_empty(0)
        # that dropout draws anew is for ``check_memory`` to say
        was_training = module.training
        module.eval()
        try:
            with torch.no_grad(), torch.random.fork_rng(devices=[]):
                self._layout, self._leaves = self._learn_layout()
                self._check_start()
        finally:
            module.train(was_training)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """The tensors of the module's state, by their number."""
        return {str(i): (leaf.shape, leaf.dtype) for i, leaf in enumerate(self._leaves)}

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """The module's state at the start of an episode: TensorDict [batch_size]."""
        if self._start is None:
            return super().initial_state(batch_size)
        batch = batch_shape(batch_size)
        flat = self._from_module(self._start(self.module, math.prod(batch)))
        state = TensorDict({}, batch_size=batch)
        for name, (shape, dtype) in self.state_leaves().items():
            leaf = flat[name].to(self.like.device, dtype or self.like.dtype)
            state[name] = leaf.reshape(*batch, *shape)
        return state

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See :class:`MemoryContract`."""
        self._check(x, state, is_init)
        fresh = self.initial_state(len(x))
        inner = is_init[:, 1:].any(dim=0).nonzero().flatten() + 1
        outputs = []
        for begin, end in pairwise([0, *inner.tolist(), x.shape[1]]):
            state = fresh.where(is_init[:, begin], state)
            y, after = self._read(self.module, x[:, begin:end], self._to_module(state))
            state = self._from_module(after)
            outputs.append(y)
        # y may be the same memory
        return torch.cat(outputs, dim=1), state.clone()

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See :class:`ReplayableMemory`."""
        self._check(x, stored, is_init, batch_ndim=2)
        return replay_by_steps(self, x, stored, is_init)

    def _to_module(self, state: TensorDict) -> Any:
        """A state as the module has it."""
        leaves = []
        for number, leaf in enumerate(self._leaves):
            leaves.append(state[str(number)].movedim(0, leaf.batch_axis).contiguous())
        return _arrange(iter(leaves), self._layout)

    def _from_module(self, state: Any) -> TensorDict:
        """A state of the module as TensorDict [B]."""
        leaves = {}
        for number, tensor in enumerate(_flat(state)):
            leaves[str(number)] = tensor.movedim(self._leaves[number].batch_axis, 0)
        rows = [len(tensor) for tensor in leaves.values()][:1]
        return TensorDict(leaves, batch_size=rows)

    def _learn_layout(self) -> tuple[Any, list[Leaf]]:
        """How the module arranges its state, from runs over batches and chunks of several sizes."""
        first, layout = self._state_after(rows=2, steps=1)
        wider, _ = self._state_after(rows=3, steps=1)
        longer, _ = self._state_after(rows=2, steps=2)
        if self._start is not None:
            begins_with, layout = self._tensors(self._start(self.module, 2))
            if [leaf.shape for leaf in begins_with] != [leaf.shape for leaf in first]:
                raise ValueError(
                    f"start gives a state of {_shapes(begins_with)}, and {self._name} returns one "
                    f"of {_shapes(first)}: they have to be the same"
                )
        if [leaf.shape for leaf in first] != [leaf.shape for leaf in longer]:
            raise ValueError(
                f"the state of {self._name} is {_shapes(first)} after one step and "
                f"{_shapes(longer)} after two: that of a memory keeps its shape, so give it a "
                "window of fixed length"
            )
        leaves = []
        for two, three in zip(first, wider, strict=True):
            axes = []
            for axis, sizes in enumerate(zip(two.shape, three.shape, strict=True)):
                if sizes == (2, 3):
                    axes.append(axis)
            if len(axes) != 1:
                raise ValueError(
                    f"the state of {self._name} holds {list(two.shape)} for a batch of two and "
                    f"{list(three.shape)} for one of three: one axis of each tensor has to be the "
                    "batch, so that episodes can begin one by one"
                )
            shape = list(two.shape)
            shape.pop(axes[0])
            dtype = None if two.dtype == self.like.dtype else two.dtype
            leaves.append(Leaf(axes[0], tuple(shape), dtype))
        return layout, leaves

    def _state_after(self, rows: int, steps: int) -> tuple[list[Tensor], Any]:
        """The tensors of the module's state after some steps of zeros, and their arrangement."""
        x = self.like.new_zeros(rows, steps, self.input_size)
        state = None if self._start is None else self._start(self.module, rows)
        try:
            out = self._read(self.module, x, state)
        except (TypeError, ValueError, RuntimeError, AttributeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise TypeError(
                f"{self._name} cannot be run on x {list(x.shape)} and the state "
                f"{'None' if state is None else 'of start'} ({reason}): say how with "
                "run=lambda module, x, state: ..., and what it begins with by start="
            ) from error
        if not isinstance(out, tuple) or len(out) != 2 or not isinstance(out[0], Tensor):
            raise TypeError(
                f"{self._name} gives a {type(out).__name__} and not (y, state): say how it is run "
                "with run=lambda module, x, state: ..."
            )
        y, state = out
        if y.shape != (rows, steps, self.hidden_size):
            raise ValueError(
                f"{self._name} makes {list(y.shape)} of x {list(x.shape)}: expected "
                f"{[rows, steps, self.hidden_size]}, that is [B, T, hidden_size]"
            )
        return self._tensors(state)

    def _tensors(self, state: Any) -> tuple[list[Tensor], Any]:
        """The tensors of a state of the module, and their arrangement."""
        leaves = _flat(state)
        for leaf in leaves:
            if not isinstance(leaf, Tensor):
                raise TypeError(
                    f"the state of {self._name} holds a {type(leaf).__name__}, and not tensors "
                    "alone, in tuples, lists or dictionaries: convert it in run="
                )
        nothing = iter([None] * len(leaves))
        return leaves, _arrange(nothing, state)

    def _check_start(self) -> None:
        """Raise ValueError if the module, given None, begins with something else than zeros."""
        if self._start is not None or self.like.is_meta:
            return
        numbers = torch.linspace(-1, 1, 6 * self.input_size).reshape(2, 3, self.input_size)
        x = numbers.to(self.like.device, self.like.dtype)
        of_none, _ = self._read(self.module, x, None)
        of_zeros, _ = self._read(self.module, x, self._to_module(self.initial_state(2)))
        if not torch.allclose(of_none, of_zeros):
            raise ValueError(
                f"{self._name} begins with something else than zeros: say what with "
                "start=lambda module, batch_size: ..."
            )


def _call(module: nn.Module, x: Tensor, state: Any) -> tuple[Tensor, Any]:
    """Run a module that is called as ``module(x, state)``, whichever axis is its first."""
    if getattr(module, "batch_first", True):
        return module(x, state)  # type: ignore[no-any-return]
    y, state = module(x.transpose(0, 1), state)
    return y.transpose(0, 1), state


def _flat(state: Any) -> list[Any]:
    """What stands in tuples, lists and dictionaries, in their order."""
    if isinstance(state, Mapping):
        state = list(state.values())
    if not isinstance(state, (tuple, list)):
        return [state]
    leaves = []
    for part in state:
        leaves.extend(_flat(part))
    return leaves


def _arrange(leaves: Iterator[Any], layout: Any) -> Any:
    """The inverse of :func:`_flat`: leaves in the tuples, lists and dictionaries of ``layout``."""
    if isinstance(layout, Mapping):
        return {key: _arrange(leaves, part) for key, part in layout.items()}
    if not isinstance(layout, (tuple, list)):
        return next(leaves)
    parts = [_arrange(leaves, part) for part in layout]
    has_names = hasattr(layout, "_fields")
    return type(layout)(*parts) if has_names else type(layout)(parts)


def _shapes(leaves: Sequence[Tensor]) -> str:
    """Shapes, for a message."""
    return str([list(leaf.shape) for leaf in leaves])
