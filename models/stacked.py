"""Several networks of one shape as one: weights stacked along a first dimension, run together by ``torch.vmap``."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.func import functional_call

from arcade_torch.models.networks import MemoryNetwork

__all__ = ["StackedNetworks"]


class StackedNetworks(nn.Module):
    """G networks of one shape as one network over G groups of rows.

    Row ``g * B + i`` of every argument and result, [G * B, ...], belongs to network ``g``, so that actors, losses and
    collectors made for one network work on all. The parameters are those of the networks, stacked [G, ...]; the
    networks given keep working and share their memory: what an optimiser does to the stack shows in them, and what
    ``load_state_dict`` or ``calibrate`` does to one of them shows in the stack.

    Args:
        networks: networks that differ in the numbers in them alone.

    Raises:
        ValueError: there is none, they differ in shape, or their memory model does not run under ``torch.vmap``.

    Example:
        >>> from arcade_torch.models import make_network
        >>> one, other = make_network("small", "gru"), make_network("small", "gru")
        >>> both = StackedNetworks([one, other])
        >>> pixels = torch.zeros(6, 7, 32, 32, 3, dtype=torch.uint8)
        >>> last_action, is_init = torch.zeros(6, 7, dtype=torch.int64), torch.zeros(6, 7, dtype=torch.bool)
        >>> q, state = both(pixels, last_action, is_init, both.initial_state(6))
        >>> alone, _ = other(pixels[3:], last_action[3:], is_init[3:], other.initial_state(3))
        >>> q.shape, torch.allclose(q[3:], alone, atol=1e-5)
        (torch.Size([6, 7, 5]), True)
    """

    def __init__(self, networks: Sequence[MemoryNetwork]) -> None:
        super().__init__()
        if not networks:
            raise ValueError("there is no network to stack: give at least one")
        self.size = len(networks)
        self._one = [networks[0]]  # in a list: its parameters are not to be counted as ours
        self._tail = [_Tail(networks[0])]
        self._names: dict[str, str] = {}  # of a tensor in one network: its name here
        for name, parameter in networks[0].named_parameters():
            self._add(name, [n.get_parameter(name) for n in networks], parameter.requires_grad)
        for name, _ in networks[0].named_buffers():
            self._add(name, [n.get_buffer(name) for n in networks], None)
        self._check_vmap()

    def _add(self, name: str, tensors: list[Tensor], trained: bool | None) -> None:
        """Stack one parameter (or buffer, ``trained`` None) of all networks, and let theirs be views of it."""
        first = tensors[0]
        if any(t.shape != first.shape or t.dtype != first.dtype for t in tensors):
            raise ValueError(f"the networks differ in the shape of {name}: only networks of one shape can be stacked")
        # With the strides of one: slices keep its memory format.
        stack = torch.empty_strided(
            (len(tensors), *first.shape), (first.numel(), *first.stride()), dtype=first.dtype, device=first.device
        )
        for row, tensor in zip(stack, tensors, strict=True):
            row.copy_(tensor.detach())
            tensor.data = row
        own = name.replace(".", "/")
        if trained is None:
            self.register_buffer(own, stack)
        else:
            self.register_parameter(own, nn.Parameter(stack, requires_grad=trained))
        self._names[name] = own

    def _check_vmap(self) -> None:
        """Refuse a memory model that cannot run stacked, before anything else is made."""
        one, rows = self._one[0], self.size
        device = next(self.parameters()).device
        side = one.encoder.stored_size
        pixels = torch.zeros(rows, 2, side, side, 3, dtype=torch.uint8, device=device)
        last_action = torch.zeros(rows, 2, dtype=torch.int64, device=device)
        flags = torch.zeros(rows, 2, dtype=torch.bool, device=device)
        try:
            out, _ = self(pixels, last_action, flags, self.initial_state(rows))
            out.sum().backward()
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            raise ValueError(f"it does not run under torch.vmap, so train its seeds one by one ({reason})") from error
        for parameter in self.parameters():
            parameter.grad = None

    def _tensors(self, prefix: str = "") -> dict[str, Tensor]:
        """Stacked parameters and buffers by their name in one network, those below a prefix."""
        names = self._names.items()
        return {name.removeprefix(prefix): getattr(self, own) for name, own in names if name.startswith(prefix)}

    def encode(self, pixels: Tensor) -> Tensor:
        """Features float [G * B, ..., E] of frames uint8 [G * B, ..., S, S, C], each group by its own encoder."""
        return self.encode_fused(pixels) if pixels.is_cuda else self.encode_in_turn(pixels)

    def encode_in_turn(self, pixels: Tensor) -> Tensor:
        """:meth:`encode`, one encoder after the other: a quarter faster on a CPU than grouped convolutions."""
        encoder = self._one[0].encoder
        weights = {name: stack.unbind(0) for name, stack in self._tensors("encoder.").items()}
        parts = [
            functional_call(encoder, {name: rows[g] for name, rows in weights.items()}, (part,))
            for g, part in enumerate(self._groups(pixels))
        ]
        return torch.cat(parts)

    def encode_fused(self, pixels: Tensor) -> Tensor:
        """:meth:`encode` with one kernel for all groups, where launching kernels is what costs."""
        encoder = self._one[0].encoder

        def read(weights: dict[str, Tensor], part: Tensor) -> Tensor:
            features: Tensor = functional_call(encoder, weights, (part,))
            return features

        return torch.vmap(read)(self._tensors("encoder."), self._groups(pixels)).flatten(0, 1)

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDictBase
    ) -> tuple[Tensor, TensorDict]:
        """Outputs float [G * B, T, A] of features [G * B, T, E], and the state after the last step; see
        ``MemoryNetwork.remember``.
        """
        rows = features.shape[0] // self.size
        tail = self._tail[0]
        weights = {f"network.{n}": t for n, t in self._tensors().items() if not n.startswith("encoder.")}

        def read(weights: dict[str, Tensor], *inputs: Any) -> tuple[Tensor, dict[str, Any]]:
            features, last_action, is_init, before = inputs
            state = TensorDict(before, batch_size=[rows])
            out, after = functional_call(tail, weights, (features, last_action, is_init, state))
            return out, after.to_dict()

        grouped = [self._groups(x) for x in (features, last_action, is_init)]
        out, after = torch.vmap(read)(weights, *grouped, _map(self._groups, state.to_dict()))
        flat = _map(lambda x: x.flatten(0, 1), after)
        return out.flatten(0, 1), TensorDict(flat, batch_size=[self.size * rows])

    def forward(
        self, pixels: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDictBase
    ) -> tuple[Tensor, TensorDict]:
        """:meth:`encode` and :meth:`remember` in one, [G * B, T, ...] to (float [G * B, T, A], state [G * B])."""
        return self.remember(self.encode(pixels), last_action, is_init, state)

    def initial_state(self, batch_size: int) -> TensorDict:
        """State before the first observation, TensorDict [G * B], each group's own."""
        return self._one[0].initial_state(batch_size)

    def _groups(self, rows: Tensor) -> Tensor:
        """[G * B, ...] as [G, B, ...]."""
        return rows.reshape(self.size, -1, *rows.shape[1:])


class _Tail(nn.Module):
    """Everything of a network behind its encoder, as the ``forward`` of a module."""

    def __init__(self, network: MemoryNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDict
    ) -> tuple[Tensor, TensorDict]:
        """``MemoryNetwork.remember``."""
        return self.network.remember(features, last_action, is_init, state)


def _map(function: Any, nested: dict[str, Any]) -> dict[str, Any]:
    """Apply a function to the tensors of nested dictionaries."""
    return {k: _map(function, v) if isinstance(v, dict) else function(v) for k, v in nested.items()}
