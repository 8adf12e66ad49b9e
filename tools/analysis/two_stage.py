"""Gradients of a decision with respect to every frame before it, in two stages.

The encoder works frame by frame, so memory and head are differentiated once, with respect to the features (giving J,
outputs x steps x features), and J is then pushed through the encoder in chunks of frames. The cost is one backward
pass of the encoder for each frame and output, whatever the memory model; memory use is that of one chunk. Frames whose
row of J is exactly zero have no gradient and are skipped.
"""

from typing import Any, Literal

import torch
from torch import Tensor

from arcade_torch.tools.analysis.policy import Encode, Outputs, Policy

Reduce = Literal["per_action", "sum"]
Norm = Literal["l2sq", "l2", "l1"]


def memory_stage(
    policy: Policy,
    scalars: Outputs,
    features: Tensor,
    last_action: Tensor,
    is_init: Tensor,
    state: Any,
    reduce: Reduce,
) -> tuple[Tensor, Tensor]:
    """Gradients of the outputs at the last step with respect to the features.

    One copy of the window for each output stands in the batch, so that a single backward pass gives all rows of J with
    any memory model, without batching rules for its operators.

    Args:
        policy: whose ``remember`` is differentiated.
        scalars: what of its outputs.
        features: float [T, E].
        last_action: int64 [T].
        is_init: bool [T].
        state: before the first frame, batch of one; None for the initial one.
        reduce: ``sum`` adds the outputs up before differentiating.

    Returns:
        ``(J [K, T, E] (K = 1 for "sum"), outputs at the last step [K])``.
    """
    if state is None:
        state = policy.initial_state(1)
    with torch.no_grad():
        raw, _ = policy.remember(features[None], last_action[None], is_init[None], state)
        count = 1 if reduce == "sum" else scalars(raw[:, -1]).shape[-1]
    leaf = features.expand(count, *features.shape).clone().requires_grad_()
    out, _ = policy.remember(leaf, last_action.expand(count, -1), is_init.expand(count, -1), repeated(state, count))
    chosen = scalars(out[:, -1])
    scalar = chosen.sum() if reduce == "sum" else chosen.diagonal().sum()
    (gradient,) = torch.autograd.grad(scalar, leaf, allow_unused=True)
    gradient = torch.zeros_like(leaf) if gradient is None else gradient
    return gradient.detach(), chosen[0].detach()


def repeated(state: Any, count: int) -> Any:
    """A batch of equal states from a batch of one: a TensorDict, a tensor, or None."""
    if state is None:
        return None
    if hasattr(state, "batch_size"):
        return state.reshape(1).expand(count).clone()
    return state.expand(count, *state.shape[1:])


def encoder_stage(
    encode: Encode, frames: Tensor, cotangents: Tensor, norm: Norm, chunk: int, dtype: torch.dtype, maps: bool = True
) -> tuple[Tensor | None, Tensor]:
    """Push J through the encoder chunk by chunk and reduce at once.

    Args:
        encode: the encoder.
        frames: uint8 or float [T, H, W, C].
        cotangents: J, float [K, T, E].
        norm: see `norms`.
        chunk: frames at once.
        dtype: of the differentiated frames.
        maps: whether single pixels are wanted.

    Returns:
        ``(sums over outputs of the norm over channels [T, H, W] or None, of the norm over the frame [T])``.
    """
    steps = frames.shape[0]
    totals = cotangents.new_zeros(steps, dtype=dtype)
    pixels = cotangents.new_zeros(frames.shape[:-1], dtype=dtype) if maps else None
    alive = cotangents.ne(0).any(-1).any(0).nonzero().squeeze(-1)
    for index in alive.split(chunk):
        part = frames[index].to(dtype).requires_grad_()
        features = encode(part)
        for row in cotangents[:, index]:
            (gradient,) = torch.autograd.grad(
                features, part, row.to(features.dtype), retain_graph=True, allow_unused=True
            )
            if gradient is not None:
                per_pixel, per_frame = norms(gradient, norm, maps)
                totals[index] += per_frame
                if pixels is not None and per_pixel is not None:
                    pixels[index] += per_pixel
    return pixels, totals


def norms(gradient: Tensor, norm: Norm, maps: bool = True) -> tuple[Tensor | None, Tensor]:
    """Norm over channels [T, H, W] (None without ``maps``) and over whole frames [T] of gradients [T, H, W, C]."""
    if not maps:
        flat = gradient.flatten(1)
        if norm == "l1":
            return None, flat.abs().sum(1)
        squares = (flat * flat).sum(1)
        return None, squares if norm == "l2sq" else squares.sqrt()
    if norm == "l1":
        per_pixel = gradient.abs().sum(-1)
        return per_pixel, per_pixel.sum((1, 2))
    squares = gradient.square().sum(-1)
    if norm == "l2sq":
        return squares, squares.sum((1, 2))
    return squares.sqrt(), squares.sum((1, 2)).sqrt()


def encode_all(encode: Encode, frames: Tensor, chunk: int, dtype: torch.dtype) -> Tensor:
    """Features [T, E] of frames [T, H, W, C], without gradients, ``chunk`` frames at once."""
    with torch.no_grad():
        return torch.cat([encode(part.to(dtype)) for part in frames.split(chunk)])
