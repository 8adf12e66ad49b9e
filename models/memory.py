"""What a memory model is: two methods, and the half that ours share."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from arcade_torch.models.arguments import check_sizes, is_whole

__all__ = [
    "MASKS", "Memory", "MemoryContract", "ReplayableMemory", "batch_shape", "first_state", "replay",
    "replay_by_steps", "step_mask",
]  # fmt: skip

MASKS: tuple[str | tuple[str, ...], ...] = ("mask", ("collector", "mask"))
"""Where TorchRL says which steps are no padding."""


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
        ValueError: a size is no whole number, or not positive.
    """

    state_shape: tuple[int, ...] | None = None
    averages_values = False
    """Whether every output is a function of the input and of a weighted mean over the episode's
    steps, as in softmax and linear attention; ``check_memory`` then has one more law."""
    surrogate_gradients = False
    """Whether some function in it is a step whose backward pass has another's derivative, as in
    ``bmru``; ``check_memory`` then compares no gradient with finite differences."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        check_sizes(input_size=input_size, hidden_size=hidden_size)
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

        Raises:
            ValueError: ``batch_size`` is no whole number from 0, nor several.
        """
        batch = batch_shape(batch_size)
        state = TensorDict({}, batch_size=batch)
        for name, (shape, dtype) in self.state_leaves().items():
            sizes = (*batch, *shape)
            state[name] = torch.zeros(
                sizes, dtype=dtype or self.like.dtype, device=self.like.device
            )
        return state

    def _check(self, x: Tensor, state: TensorDict, is_init: Tensor, batch_ndim: int = 1) -> None:
        """Raise ValueError unless shapes and types are those of ``forward`` (``batch_ndim`` 1) or
        ``replay`` (2).
        """
        self._check_input(x)
        _check_start_flags(is_init, x)
        self._check_state(state, x.shape[:batch_ndim])

    def _check_input(self, x: Any) -> None:
        if not isinstance(x, Tensor):
            raise ValueError(f"x must be a tensor [B, T, {self.input_size}], got {type(x)}")
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
        if not x.is_meta and torch.is_autocast_enabled(x.device.type):  # meta knows no autocast
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
        for name, (_, dtype) in self.state_leaves().items():
            expected_dtype = dtype or self.like.dtype
            if state[name].dtype != expected_dtype:
                raise ValueError(
                    f"{name!r} of the state must be {expected_dtype}, got {state[name].dtype}: "
                    "cast the state with the model"
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


def batch_shape(batch_size: int | Sequence[int]) -> list[int]:
    """A batch size, one number or several, as a list.

    Raises:
        ValueError: they are not whole numbers from 0.
    """
    sizes = list(batch_size) if isinstance(batch_size, Sequence) else [batch_size]
    for size in sizes:
        if (type(size) is int or is_whole(size)) and size >= 0:
            continue
        raise ValueError(f"batch_size must be whole numbers from 0, got {batch_size!r}")
    return sizes


def first_state(memory: nn.Module, batch_size: int | Sequence[int]) -> TensorDict:
    """The ``initial_state`` of anybody's module.

    Raises:
        TypeError: the module is no memory model: it has no such method, or gives no TensorDict.
        ValueError: a tensor of the state does not begin with the batch.
    """
    name = type(memory).__name__
    if not hasattr(memory, "initial_state"):
        raise TypeError(
            f"{name} has no initial_state(batch_size), which gives a TensorDict: see "
            "docs/guides/memory.md; RecurrentMemory makes a memory of a module that is called as "
            "y, state = module(x, state), examples/own_memory.py writes one out"
        )
    state = memory.initial_state(batch_size)  # type: ignore[operator]
    if not isinstance(state, TensorDictBase):
        raise TypeError(
            f"initial_state of {name} gives no TensorDict, but {type(state).__name__}: "
            'TensorDict({"h": ...}, batch_size=[batch_size])'
        )
    sizes = batch_shape(batch_size)
    for path, tensor in state.items(True, True):
        if list(tensor.shape[: len(sizes)]) != sizes:
            entry = path if isinstance(path, str) else ".".join(path)
            wanted = ", ".join([*map(str, sizes), "..."])
            raise ValueError(
                f"initial_state({batch_size}) of {name} gives {entry} as {list(tensor.shape)}, "
                f"expected [{wanted}]: the batch comes first"
            )
    return state


def step_mask(batch: TensorDictBase, shape: torch.Size) -> Tensor | None:
    """Which steps are no padding, bool of this shape [..., T]; None if the batch does not say."""
    masks = []
    for key in MASKS:
        mask = batch.get(key, None)
        if isinstance(mask, Tensor) and mask.shape in (shape, (*shape, 1)):
            masks.append(mask.reshape(shape).bool())
    if not masks:
        return None
    return masks[0] & masks[-1]
