"""A recurrent state as one tensor of floats, for whoever knows no TensorDict."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = ["flatten_state", "unflatten_state"]


def flatten_state(state: TensorDictBase) -> Tensor:
    """A state [B] as float32 [B, F]: all numbers of its tensors, a complex one as two."""
    parts = [torch.empty(len(state), 0, device=state.device)]
    for _, leaf in _leaves(state):
        numbers = torch.view_as_real(leaf) if leaf.is_complex() else leaf
        parts.append(numbers.reshape(len(state), -1).to(parts[0].dtype))
    device = parts[-1].device
    return torch.cat([part.to(device) for part in parts], dim=1)


def unflatten_state(flat: Tensor, example: TensorDictBase) -> TensorDictBase:
    """The inverse of `flatten_state`, with the shapes and dtypes of ``example`` [B]; whole numbers
    are cut.
    """
    state = example.clone(recurse=False)
    place = 0
    for key, leaf in _leaves(example):
        size = leaf[0].numel() * (2 if leaf.is_complex() else 1)
        numbers = flat[:, place : place + size]
        place += size
        if leaf.is_complex():
            pairs = numbers.reshape(*leaf.shape, 2).to(leaf.real.dtype).contiguous()
            state.set(key, torch.view_as_complex(pairs))
        else:
            state.set(key, numbers.reshape(leaf.shape).to(leaf.dtype))
    return state


def _leaves(state: TensorDictBase) -> list[tuple[Any, Tensor]]:
    """The tensors of a state by key, in an order that does not depend on how it was made."""
    return sorted(state.items(True, True), key=lambda item: str(item[0]))
