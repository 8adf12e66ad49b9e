"""``RecurrentMemory``: a recurrent module of any library as a memory model."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from arcade_torch.models.generators import kept_generators
from arcade_torch.models.law_subject import copy_of
from arcade_torch.models.memory import Memory, batch_shape, replay_by_steps
from arcade_torch.models.module_state import Path, arrange, empty_like, shapes_of, tensors_of
from arcade_torch.models.sequential import later_starts

__all__ = ["RecurrentMemory"]

Run = Callable[[nn.Module, Tensor, Any], tuple[Tensor, Any]]
Start = Callable[[nn.Module, int], Any]

LOOP = (
    "a cell, which reads one step, needs run= with a loop over x.unbind(1), as in "
    "docs/guides/memory.md"
)


class Leaf(NamedTuple):
    """A tensor of a module's state."""

    path: Path
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
            for the batch. None, or an empty tuple, is no state. It is tried out as a copy.
        input_size: D, features of an input step.
        hidden_size: H, features of an output step.
        run: How the module reads a chunk: ``(module, x [B, T, D], state) -> (y [B, T, H], state)``.
            None: ``module(x, state)``, with time as the first axis where ``module.batch_first`` is
            false; set it on a module of your own that reads so.
        start: The state at the start of an episode, as the module has it: ``(module, batch size)
            -> state``. None: zeros, where the module begins with them when it is given None, and
            does not learn what it begins with.

    Raises:
        TypeError: The module cannot be run so, or its state holds something that is no tensor.
        ValueError: Outputs of another size; a state that grows with the steps, has no axis for the
            batch, or begins with something else than zeros, or than ``start`` gives.

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
        _check_module(module)
        self.module = module
        self._read = _call if run is None else run
        self._start = start
        self._name = type(module).__name__
        floating = [weight for weight in module.parameters() if weight.is_floating_point()]
        if floating:
            self.like = floating[0].new_empty(0)
        with torch.no_grad(), kept_generators():
            # that dropout draws anew is for ``check_memory`` to say
            tried = copy_of(module).eval()
            self._layout, self._leaves = self._learn_layout(tried)
            if start is None and not self.like.is_meta:
                self._check_start(tried)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """The tensors of the module's state, by their number."""
        return {str(i): (leaf.shape, leaf.dtype) for i, leaf in enumerate(self._leaves)}

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """The module's state at the start of an episode: TensorDict [batch_size]."""
        if self._start is None:
            return super().initial_state(batch_size)
        batch = batch_shape(batch_size)
        rows = math.prod(batch)
        flat = self._from_module(self._start(self.module, rows), rows)
        state = TensorDict({}, batch_size=batch)
        for name, (shape, dtype) in self.state_leaves().items():
            leaf = flat[name].to(self.like.device, dtype or self.like.dtype)
            state[name] = leaf.reshape(*batch, *shape)
        return state

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See :class:`MemoryContract`."""
        self._check(x, state, is_init)
        if not self._leaves:
            y, _ = self._advance(x, self._to_module(state))
            return y, state.clone()
        fresh = self.initial_state(len(x))
        outputs = []
        for begin, end in pairwise([0, *later_starts(is_init), x.shape[1]]):
            state = fresh.where(is_init[:, begin], state)
            y, after = self._advance(x[:, begin:end], self._to_module(state))
            state = self._from_module(after, len(x))
            outputs.append(y)
        # y may be the same memory
        return torch.cat(outputs, dim=1), state.clone()

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See :class:`ReplayableMemory`."""
        self._check(x, stored, is_init, batch_ndim=2)
        return replay_by_steps(self, x, stored, is_init)

    def _advance(self, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Run the module; say what to do where torch has no ``vmap`` rule for it."""
        try:
            return self._read(self.module, x, state)
        except RuntimeError as error:
            if "Batching rule not implemented" not in str(error):
                raise
            raise RuntimeError(
                f"{self._name} knows no vmap, by which GAE and losses with several critics read: "
                "give GAE (or make_value_estimator) and such losses deactivate_vmap=True, or take "
                "the memory 'gru' or 'lstm', or GRU or LSTM of torchrl.modules. Make the networks "
                "anew: TorchRL leaves those of this call with weights that nothing else reads"
            ) from error

    def _to_module(self, state: TensorDict) -> Any:
        """A state as the module has it."""
        tensors = {}
        for number, leaf in enumerate(self._leaves):
            tensors[leaf.path] = state[str(number)].movedim(0, leaf.batch_axis).contiguous()
        return arrange(tensors, self._layout, len(state))

    def _from_module(self, state: Any, rows: int) -> TensorDict:
        """A state of the module as TensorDict [B]."""
        tensors = tensors_of(state)
        leaves = {}
        for number, leaf in enumerate(self._leaves):
            leaves[str(number)] = tensors[leaf.path].movedim(leaf.batch_axis, 0)
        return TensorDict(leaves, batch_size=[rows])

    def _learn_layout(self, module: nn.Module) -> tuple[Any, list[Leaf]]:
        """How the module arranges its state, from runs over batches and chunks of several sizes."""
        state, first = self._state_after(module, rows=2, steps=1)
        _, wider = self._state_after(module, rows=3, steps=1)
        _, longer = self._state_after(module, rows=2, steps=2)
        if self._start is not None:
            state = self._begin(module, 2)
            begins_with = self._tensors(state)
            if shapes_of(begins_with) != shapes_of(first):
                raise ValueError(
                    f"start gives a state of {_shapes(begins_with)}, and {self._name} returns one "
                    f"of {_shapes(first)}: they have to be the same"
                )
        if shapes_of(first) != shapes_of(longer):
            grows = (
                f"the state of {self._name} is {_shapes(first)} after one step and "
                f"{_shapes(longer)} after two"
            )
            if shapes_of(first) == shapes_of(wider):
                raise ValueError(
                    f"{grows}, whatever the batch: it takes time for its first axis; set "
                    "batch_first = False on it, give what is inside of it batch_first=True, or "
                    "exchange the axes in run="
                )
            raise ValueError(
                f"{grows}: that of a memory keeps its shape, so give it a window of fixed length; "
                f"{LOOP}"
            )
        leaves = []
        for path in tensors_of(state):
            axes = _batch_axes(first[path], wider.get(path))
            if len(axes) != 1 or first.keys() != wider.keys():
                raise ValueError(
                    f"the state of {self._name} is {_shapes(first)} for a batch of two and "
                    f"{_shapes(wider)} for one of three: one axis of each tensor has to be the "
                    "batch, so that episodes can begin one by one"
                )
            shape = list(first[path].shape)
            shape.pop(axes[0])
            dtype = first[path].dtype
            own_dtype = None if dtype == self.like.dtype else dtype
            leaves.append(Leaf(path, axes[0], tuple(shape), own_dtype))
        return empty_like(state, rows=2), leaves

    def _state_after(
        self, module: nn.Module, rows: int, steps: int
    ) -> tuple[Any, dict[Path, Tensor]]:
        """The module's state after some steps of zeros, and its tensors."""
        x = self.like.new_zeros(rows, steps, self.input_size)
        state = None if self._start is None else self._begin(module, rows)
        _, after = self._try(module, x, state)
        return after, self._tensors(after)

    def _begin(self, module: nn.Module, rows: int) -> Any:
        """What ``start`` gives, on the device of the parameters."""
        try:
            state = self._start(module, rows)  # type: ignore[misc]
        except Exception as error:
            raise TypeError(
                f"start of {self._name} fails for a batch of {rows} ({_reason(error)}): it is "
                "called as start(module, batch_size), and gives the state as the module has it"
            ) from error
        tensors = {}
        for path, tensor in self._tensors(state).items():
            tensors[path] = tensor.to(self.like.device)
        return arrange(tensors, state, rows)

    def _try(self, module: nn.Module, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Run the module; errors, and outputs that do not fit, are told in one line."""
        try:
            out = self._read(module, x, state)
        except Exception as error:
            begins_with = "a state of zeros" if self._start is None else "the state of start"
            advice = "say how with run=lambda module, x, state: ..., "
            if self._read is _call:
                advice += "by batch_first = False on it, where time is its first axis, "
            advice += "and what it begins with by start="
            raise TypeError(
                f"{self._name} cannot be run on x {list(x.shape)} and "
                f"{'the state None' if state is None else begins_with} ({_reason(error)}): "
                f"{LOOP if isinstance(module, nn.RNNCellBase) else advice}"
            ) from error
        is_pair = isinstance(out, (tuple, list)) and len(out) == 2
        if not is_pair or not isinstance(out[0], Tensor):
            kind = type(out).__name__
            if type(out) is tuple:
                kind = f"({', '.join(type(part).__name__ for part in out)})"
            raise TypeError(
                f"{self._name} gives {kind} and not (y, state) with a tensor y: say how it is "
                "run with run=lambda module, x, state: ..."
            )
        y, after = out
        expected = [*x.shape[:2], self.hidden_size]
        if list(y.shape) != expected:
            advice = f"; {LOOP}" if y.shape[:-1] != x.shape[:-1] else ""
            raise ValueError(
                f"{self._name} makes {list(y.shape)} of x {list(x.shape)}: expected {expected}, "
                f"that is [B, T, hidden_size]{advice}"
            )
        return y, after

    def _tensors(self, state: Any) -> dict[Path, Tensor]:
        """The tensors of a state of the module, and nothing else."""
        tensors = tensors_of(state)
        for leaf in tensors.values():
            if not isinstance(leaf, Tensor):
                raise TypeError(
                    f"the state of {self._name} holds {type(leaf).__name__}, and not tensors "
                    "alone, in tuples, lists or dictionaries: convert it in run="
                )
        return tensors

    def _check_start(self, module: nn.Module) -> None:
        """Raise ValueError if a module, given None, begins with something else than zeros.

        It is tried with moved weights too: those of a start that is learned, or of a factor of the
        output, may be 0 at first.
        """
        numbers = torch.linspace(-1, 1, 6 * self.input_size).reshape(2, 3, self.input_size)
        x = numbers.to(self.like.device, self.like.dtype)
        moved = copy_of(module)
        for weight in moved.parameters():
            if weight.requires_grad:
                noise = torch.randn(weight.shape, device="cpu")
                weight.add_(noise.to(weight), alpha=0.1)
        for tried in (module, moved):
            zeros = self._to_module(super().initial_state(2))
            # copies: what a module keeps of a call in itself is for ``check_memory`` to say
            of_none, _ = self._try(copy_of(tried), x, None)
            of_zeros, _ = self._try(copy_of(tried), x, zeros)
            if not torch.allclose(of_none, of_zeros, equal_nan=True):
                self._refuse_kept_state(tried, x)
                raise ValueError(
                    f"{self._name} begins with something else than zeros, or learns what it begins "
                    "with: say what with start=lambda module, batch_size: ..."
                )

    def _refuse_kept_state(self, module: nn.Module, x: Tensor) -> None:
        """Raise ValueError if a module that is given None goes on from its call before."""
        again = copy_of(module)
        first, _ = self._try(again, x, None)
        second, _ = self._try(again, x, None)
        if not torch.allclose(first, second, equal_nan=True):
            raise ValueError(
                f"two equal calls of {self._name} differ, both with the state None: it keeps its "
                "state in itself, or draws random numbers; what it carries on belongs into the "
                "state that it returns, and None is where an episode begins"
            )


def _call(module: nn.Module, x: Tensor, state: Any) -> tuple[Tensor, Any]:
    """Run a module that is called as ``module(x, state)``, whichever axis is its first."""
    if getattr(module, "batch_first", True):
        return module(x, state)  # type: ignore[no-any-return]
    y, state = module(x.transpose(0, 1), state)
    return y.transpose(0, 1), state


def _check_module(module: Any) -> None:
    """Raise TypeError unless it is a module with weights that have their shapes."""
    if not isinstance(module, nn.Module):
        is_class = isinstance(module, type)
        got = f"the class {module.__name__}: make one of it" if is_class else repr(module)
        raise TypeError(f"module has to be an nn.Module, such as nn.GRU(8, 16), got {got}")
    for name, weight in module.named_parameters():
        if is_lazy(weight):
            raise TypeError(
                f"{name} of {type(module).__name__} has no shape before the first call: take "
                "nn.Linear, with its sizes, in the place of nn.LazyLinear"
            )


def _batch_axes(two: Tensor, three: Tensor | None) -> list[int]:
    """Axes that are as long as the batch, from the tensors for batches of two and of three."""
    if three is None or three.ndim != two.ndim:
        return []
    sizes = zip(two.shape, three.shape, strict=True)
    return [axis for axis, lengths in enumerate(sizes) if lengths == (2, 3)]


def _reason(error: Exception) -> str:
    """The first line of an error."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _shapes(tensors: Mapping[Path, Tensor]) -> str:
    """Shapes, for a message."""
    shapes = []
    for path, shape in shapes_of(tensors).items():
        name = ".".join(map(str, path))
        shapes.append(f"{name}: {shape}" if name else str(shape))
    return ", ".join(shapes) or "no tensor"
