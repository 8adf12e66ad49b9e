"""Whole networks: encoder, last action, memory block, head; each is a TensorDict module."""

import copy
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes, is_whole
from arcade_torch.models.encoders import Encoder
from arcade_torch.models.memory import batch_shape, first_state, replay, step_mask
from arcade_torch.models.recurrence import Key, Recurrence, Store
from arcade_torch.models.registry import make_memory

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

__all__ = ["MemoryBlock", "MemoryNetwork"]

SKIPS = ("residual", "none")


class MemoryBlock(nn.Module):
    """x = W u; then per layer y = cell(x), z = LeakyReLU(LayerNorm(V y)), and x + z (skip
    "residual") or z ("none").

    Keeps the contract of a memory model itself (``MemoryContract``), with one nested state per
    layer: ``("layer0", ...)``, ``("layer1", ...)``. LayerNorm has no parameters.

    Args:
        input_size: D.
        hidden_size: H, width of the cells and of the output.
        memory: a name (:func:`memory_names`) or a factory ``(input_size, hidden_size, **options) ->
            nn.Module``.
        layers: number of cells.
        skip: "residual" lets the input bypass the memory, as the paper says; "none" is what its
            code does.
        memory_options: passed on to the cells.

    Raises:
        ValueError: unknown memory or skip, fewer than one layer, or a size that is no whole number
            from 1.
        TypeError: a memory that is neither a name nor a factory.
    """

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        memory: str | Callable[..., nn.Module] = "lru",
        *,
        layers: int = 2,
        skip: Literal["residual", "none"] = "residual",
        memory_options: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if skip not in SKIPS:
            raise ValueError(f"skip must be one of {', '.join(SKIPS)}, got {skip!r}")
        for name, size in (("input_size", input_size), ("hidden_size", hidden_size)):
            if not is_whole(size) or size < 1:
                raise ValueError(f"{name} must be a whole number from 1, got {size!r}")
        check_sizes(layers=layers)
        check_memory_name(memory)
        if layers < 1:
            raise ValueError(f"layers must be at least 1, got {layers}")
        options = memory_options or {}
        self.input_size = input_size
        self.hidden_size = hidden_size
        self.residual = skip == "residual"
        self.linear = nn.Linear(input_size, hidden_size)
        make_cell = partial(make_memory, memory) if isinstance(memory, str) else memory
        self.cells = nn.ModuleList()
        for _ in range(layers):
            self.cells.append(make_cell(hidden_size, hidden_size, **options))
        self.linears = nn.ModuleList()
        for _ in range(layers):
            self.linears.append(nn.Linear(hidden_size, hidden_size))
        self.names = [f"layer{i}" for i in range(layers)]

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Read a chunk of steps.

        Args:
            x: float [B, T, D].
            state: TensorDict [B] with one nested state per layer.
            is_init: bool [B, T].

        Returns:
            (float [B, T, H], state TensorDict [B]).
        """
        return self._run(x, state, is_init, list(self.cells), [x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Read stored sequences, one stored state per step (see ``ReplayableMemory``); all [B,
        T].
        """
        readers = [partial(replay, cell) for cell in self.cells]
        return self._run(x, stored, is_init, readers, x.shape[:2])

    def _run(
        self,
        x: Tensor,
        state: TensorDict,
        is_init: Tensor,
        readers: Sequence[Callable[[Tensor, TensorDict, Tensor], tuple[Tensor, TensorDict]]],
        batch_size: Sequence[int],
    ) -> tuple[Tensor, TensorDict]:
        x = self.linear(x)
        states = {}
        layers = zip(self.names, self.cells, readers, self.linears, strict=True)
        for name, cell, read, linear in layers:
            y, states[name] = read(x, state[name], is_init)
            if y.dtype != x.dtype or y.shape != x.shape:
                raise ValueError(
                    f"{type(cell).__name__} gives y {y.dtype} {list(y.shape)} for x "
                    f"{x.dtype} {list(x.shape)}: its outputs have the type of x, y.to(x.dtype), "
                    "and hidden_size features"
                )
            y = F.leaky_relu_(F.layer_norm(linear(y), (self.hidden_size,)))
            x = x + y if self.residual else y
        return x, TensorDict(states, batch_size=batch_size)

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """The cells' initial states, TensorDict [batch_size] with one entry per layer."""
        states = {}
        for name, cell in zip(self.names, self.cells, strict=True):
            states[name] = first_state(cell, batch_size)
        return TensorDict(states, batch_size=batch_shape(batch_size))


class MemoryNetwork(TensorDictModuleBase):
    """From frames, last actions and start flags to one number per action, and a value beside them
    on request; a TensorDict module with a recurrent state.

    It reads ``["pixels", "last_action", "is_init", *state keys]`` and writes ``[*heads, ("next",
    *state keys)]``; a network whose block has no state has no state keys. Modes and states are
    those of :class:`MemoryModule`: one step by default, sequences in recurrent mode. With a
    predictor it then also writes ``prediction_error`` for losses to add, see the method of that
    name. :meth:`encode` and :meth:`remember` do the same on plain tensors.

    Args:
        encoder: frames to features [..., E].
        block: a memory model, E + num_actions to H.
        head: [..., H] to [..., A], with a ``value_key`` to [..., A + 1].
        num_actions: A, length of the one-hot last action; 0 leaves it out, and ``"last_action"`` is
            not read. An action outside of 0 to A - 1, such as a -1 for none, is a zero vector:
            nothing refuses it, since acting looks at no value and so never waits for a GPU.
        zero_action_on_reset: show a zero vector instead of the last action where ``is_init`` is
            set. Not with ``store="step"``: there TorchRL also sets ``is_init`` in mid-episode
            (slices, the next observations of ``GAE``).
        out_key: name of the head with one number per action, and where it is written:
            ``"action_value"`` or ``"logits"``; ``"state_value"`` for a critic.
        value_key: name of a second head, the last number of ``head``; None for no such head.
        state_key: where the recurrent state stands; give actor and critic different ones.
        store: which states a stored sequence holds, see :class:`MemoryModule`.
        predictor: what is remembered and the next one-hot action, [..., H + num_actions], to
            features [..., E].

    Attributes:
        heads: by name, which part of the output of ``head`` belongs to it.
        state_key, state_keys, store: those of :class:`MemoryModule`.

    Raises:
        ValueError: ``zero_action_on_reset`` with ``store="step"``.

    Source: POPGym Arcade, network tables.

    Example:
        >>> from arcade_torch.models import make_network
        >>> from torchrl.modules import set_recurrent_mode
        >>> network = make_network("small", "gru")
        >>> network.in_keys
        ['pixels', 'last_action', 'is_init', ('memory', 'layer0', 'h')]
        >>> network.out_keys
        ['action_value', ('next', 'memory', 'layer0', 'h')]
        >>> flags = torch.ones(2, 7, 1, dtype=torch.bool)
        >>> frames = torch.zeros(2, 7, 128, 128, 3, dtype=torch.uint8)
        >>> actions = torch.zeros(2, 7, dtype=torch.int64)
        >>> data = TensorDict({"pixels": frames, "last_action": actions, "is_init": flags}, [2, 7])
        >>> network(data[:, 0])["next", "memory", "layer0", "h"].shape
        torch.Size([2, 128])
        >>> with set_recurrent_mode(True):
        ...     network(data)["action_value"].shape
        torch.Size([2, 7, 5])
    """

    def __init__(
        self,
        encoder: Encoder,
        block: nn.Module,
        head: nn.Module,
        *,
        num_actions: int = 5,
        zero_action_on_reset: bool = False,
        out_key: Key = "action_value",
        value_key: Key | None = None,
        state_key: Key = "memory",
        store: Store = "sequence",
        predictor: nn.Module | None = None,
    ) -> None:
        super().__init__()
        if zero_action_on_reset and store == "step":
            raise ValueError(
                "zero_action_on_reset needs store='sequence': with 'step', is_init also marks cuts"
            )
        self.encoder = encoder
        self.block = block
        self.head = head
        self.predictor = predictor
        self.obs_size = encoder.obs_size
        self.num_actions = num_actions
        self.zero_action_on_reset = zero_action_on_reset
        self.register_buffer("actions", torch.arange(num_actions), persistent=False)
        self.actions: Tensor
        self.state_key = state_key
        self.recurrence = Recurrence(block, state_key, store=store)
        self.state_keys = self.recurrence.state_keys
        self.store = self.recurrence.store
        self.heads = {out_key: slice(None)}
        if value_key is not None:
            self.heads = {out_key: slice(None, -1), value_key: slice(-1, None)}
        action_keys = ["last_action"] if num_actions else []
        self.in_keys = ["pixels", *action_keys, "is_init", *self.state_keys]
        self.out_keys = [*self.heads, *self.recurrence.next_state_keys]

    def only(self, head: Key) -> "MemoryNetwork":
        """The same network, with the same weights, that writes one of its heads alone."""
        view = copy.copy(self)  # shallow: parts and weights are shared
        view.heads = {head: self.heads[head]}
        view.out_keys = [head, *self.recurrence.next_state_keys]
        return view

    def by_head(self, out: Tensor) -> dict[Key, Tensor]:
        """What :meth:`remember` gave, cut into the heads, each [..., its width]."""
        parts = {}
        for name, part in self.heads.items():
            parts[name] = out[..., part]
        return parts

    def make_tensordict_primer(self) -> "TensorDictPrimer":
        """The transform that puts initial states into an env's resets; see
        :class:`MemoryModule`.
        """
        return self.recurrence.make_primer(self.block)

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Read one step, or in recurrent mode sequences, and write the heads and the next state.

        Args:
            tensordict: any batch shape (in recurrent mode [*, T]) with ``in_keys``; frames may be
                full or compressed, state keys may be missing, which means the initial state.

        Returns:
            the same object, with ``out_keys`` (in recurrent mode with ``store="sequence"`` without
            the next states).

        Raises:
            ValueError: recurrent mode without a time dimension, or start flags that are not
                [*batch, 1].
            KeyError: an entry is missing.
        """
        x = self.encode(tensordict["pixels"])
        is_init = self.recurrence.start_flags(tensordict)
        if self.num_actions:
            x = self._append(x, tensordict["last_action"], is_init)
        y = self.recurrence.read(self.block, tensordict, x)
        if self.predictor is not None and self.recurrence.recurrent_mode:
            mask = step_mask(tensordict, tensordict.batch_size)
            tensordict.set("prediction_error", self.prediction_error(x, y, is_init, mask))
        for name, value in self.by_head(self.head(y)).items():
            tensordict.set(name, value)
        return tensordict

    def compress(self, pixels: Tensor) -> Tensor:
        """What of the frames is worth storing.

        Args:
            pixels: uint8 [..., S, S, 3].

        Returns:
            uint8 [..., 8, 8, k * k * 3] for "small": patches of a picture of 32 x 32 block means (k
            = 4; "small64": 64 x 64, k = 8); for "paper" the upper left [..., 120, 120, 3] (of 256:
            218).
        """
        return self.encoder.compress(pixels)

    def calibrate(self, pixels: Tensor) -> None:
        """Set the input scaling from frames of random play, uint8 [..., S, S, 3] or compressed
        ("paper": no-op).
        """
        self.encoder.calibrate(pixels)

    def encode(self, pixels: Tensor) -> Tensor:
        """Frames, uint8 or float 0..255, full [..., S, S, 3] or compressed, to features float
        [..., E].
        """
        return self.encoder(pixels)  # type: ignore[no-any-return]

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDict
    ) -> tuple[Tensor, TensorDict]:
        """Everything behind the encoder.

        Args:
            features: float [B, T, E].
            last_action: int64 [B, T], the action that led to each frame.
            is_init: bool [B, T], True where an episode begins.
            state: TensorDict [B], the recurrent state before step 0, see :meth:`initial_state`.

        Returns:
            (float [B, T, A], with a value head [B, T, A + 1], state TensorDict [B] after the last
            step).

        Raises:
            ValueError: last actions or start flags are not one a step, or another shape or type
                does not fit.
        """
        if self.num_actions:
            features = self._append(features, last_action, is_init)
        # a recurrence adds up what bfloat16 rounds away
        if not features.is_meta and torch.is_autocast_enabled(features.device.type):
            with torch.autocast(features.device.type, enabled=False):
                y, state = self.block(features.float(), state, is_init)
        else:
            y, state = self.block(features, state, is_init)
        return self.head(y), state

    def read_sequences(
        self, sequences: TensorDictBase, state: TensorDictBase | None = None
    ) -> dict[Key, Tensor]:
        """The heads that :meth:`forward` writes in recurrent mode, for sequences whose first states
        stand apart.

        Args:
            sequences: [B, T] with the observations of ``in_keys``.
            state: [B] with ``state_keys``, before index 0; None: every sequence begins with an
                episode.

        Returns:
            By name of the head, float [B, T, its width].
        """
        features = self.encode(sequences["pixels"])
        is_init = sequences["is_init"].squeeze(-1)
        # a network without a last action looks at none
        last_action = sequences["last_action"] if self.num_actions else torch.empty(0)
        first = self.initial_state(len(sequences))
        if state is not None and self.state_keys:
            first.update(state[self.state_key])
        out, _ = self.remember(features, last_action, is_init, first)
        return self.by_head(out)

    def prediction_error(
        self, x: Tensor, y: Tensor, is_init: Tensor, mask: Tensor | None = None
    ) -> Tensor:
        """How far each next frame's features, as deviations from the batch's, are from those
        expected before it.

        Args:
            x: float [..., T, E + num_actions], what the block read.
            y: float [..., T, H], what it gave.
            is_init: bool [..., T], True where an episode begins.
            mask: bool [..., T], False where a step is padding; None: nowhere.

        Returns:
            float [..., T, 1], mean square; 0 where no frame of the episode follows. Targets get no
            gradient.

        Source: self-prediction with stopped gradient, Ni et al. (2024), arXiv 2401.08898.
        """
        size = self.encoder.feature_size
        following = x[..., 1:, :size].detach()
        action = x[..., 1:, size:]
        nothing_follows = is_init[..., 1:, None]
        if mask is not None:
            mask = mask[..., 1:, None]
            nothing_follows = nothing_follows | ~mask
        centred = following - _mean_of_steps(following, mask)
        deviation = _mean_of_steps(centred.square(), mask).sqrt()
        target = centred / (deviation + 0.01)  # some features hardly ever change
        expected = self.predictor(torch.cat([y[..., :-1, :], action], dim=-1))  # type: ignore[misc]
        error = (expected - target).square().mean(-1, keepdim=True)
        return F.pad(error.masked_fill(nothing_follows, 0.0), (0, 0, 0, 1))

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """The block's state at the start of an episode, TensorDict [batch_size]; dtype and device
        of the parameters.
        """
        return self.block.initial_state(batch_size)  # type: ignore[operator]

    def _apply(self, *args: Any, **options: Any) -> "MemoryNetwork":
        """Fill ``actions`` again: no checkpoint holds it, ``to_empty`` leaves any numbers in it."""
        super()._apply(*args, **options)
        if torch.is_inference_mode_enabled() or not self.actions.is_inference():
            self.actions.copy_(torch.arange(self.num_actions, device=self.actions.device))
        return self

    def _append(self, features: Tensor, last_action: Tensor, is_init: Tensor) -> Tensor:
        """Features [..., E] with the one-hot last action [..., E + num_actions]; flags are bool
        [...].
        """
        _check_steps(features, last_action, is_init)
        one_hot = last_action.unsqueeze(-1) == self.actions
        if self.zero_action_on_reset:
            one_hot = one_hot & ~is_init.unsqueeze(-1)
        return torch.cat([features, one_hot.to(features.dtype)], dim=-1)


def check_memory_name(memory: Any) -> None:
    """Refuse what is neither the name of a memory nor a factory (TypeError)."""
    is_made = isinstance(memory, nn.Module)
    if isinstance(memory, str) or (callable(memory) and not is_made):
        return
    got = f"the {type(memory).__name__} that is made already" if is_made else repr(memory)
    raise TypeError(
        "memory has to be a name, such as 'lru', or a factory that makes one of the width it is "
        f"asked for, lambda input_size, hidden_size: ..., got {got}"
    )


def _check_steps(features: Tensor, last_action: Any, is_init: Any) -> None:
    """Refuse last actions and start flags that are not one a step (ValueError): torch would
    broadcast other shapes over the batch.
    """
    lead = features.shape[:-1]
    _check_one_a_step("last_action", "whole numbers", last_action, lead)
    _check_one_a_step("is_init", "bool", is_init, lead)


def _check_one_a_step(name: str, kind: str, value: Any, lead: Sequence[int]) -> None:
    given = type(value).__name__
    if isinstance(value, Tensor):
        fits = value.dtype == torch.bool if kind == "bool" else not value.is_floating_point()
        if fits and list(value.shape) == list(lead):
            return
        given = f"{value.dtype} {list(value.shape)}"
    raise ValueError(f"{name} must be {kind} {list(lead)}, one a step, got {given}")


def _mean_of_steps(values: Tensor, mask: Tensor | None) -> Tensor:
    """The mean [E] of numbers [..., T, E] over the steps that a mask [..., T, 1] counts."""
    if mask is None:
        return values.flatten(0, -2).mean(0)
    count = mask.sum().clamp_min(1)
    return values.where(mask, 0).flatten(0, -2).sum(0) / count
