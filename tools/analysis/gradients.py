"""Gradients of a decision with respect to every frame before it, in two stages of ``torch.autograd``.

The encoder works frame by frame. So the memory and the head are differentiated once with respect to the features,
which gives the Jacobian J [outputs, frames, features]; then J is multiplied with the Jacobian of the encoder, some
frames at a time. Memory use is that of one chunk. Frames whose rows of J are exactly zero are skipped.
"""

from typing import Any, Literal

import torch
from torch import Tensor

from arcade_torch.tools.analysis.policy import Encode, Outputs, Policy

Reduce = Literal["per_action", "sum"]
Norm = Literal["l2sq", "l2", "l1"]


@torch.no_grad()
def encode_frames(encode: Encode, frames: Tensor, chunk: int = 16, dtype: torch.dtype = torch.float32) -> Tensor:
    """Features [T, E] of frames [T, H, W, C] without a graph, ``chunk`` frames at a time."""
    return torch.cat([encode(part.to(dtype)) for part in frames.split(chunk)])


def memory_jacobian(
    policy: Policy,
    scalars: Outputs,
    features: Tensor,
    last_action: Tensor,
    is_init: Tensor,
    state: Any,
    reduce: Reduce,
) -> tuple[Tensor, Tensor]:
    """Jacobian of the outputs at the last step with respect to the features.

    Args:
        policy: whose ``remember`` is differentiated.
        scalars: which of its outputs, see `policy.outputs`.
        features: float [T, E].
        last_action: int64 [T].
        is_init: bool [T].
        state: before the first frame, batch of one; None for the initial one.
        reduce: ``sum`` adds the outputs before differentiating.

    Returns:
        ``(J [K, T, E] (K = 1 for "sum"), outputs at the last step [A])``.
    """
    leaf = features.clone().requires_grad_()
    start = policy.initial_state(1) if state is None else state
    out, _ = policy.remember(leaf[None], last_action[None], is_init[None], start)
    values = scalars(out[:, -1])[0]
    rows = torch.ones_like(values)[None] if reduce == "sum" else torch.eye(len(values)).to(values)
    if not values.requires_grad:
        return leaf.new_zeros(len(rows), *leaf.shape), values.detach()
    try:
        found = torch.autograd.grad(values, leaf, rows, retain_graph=True, is_grads_batched=True, allow_unused=True)[0]
    except RuntimeError:  # an operator without a batching rule
        each = [torch.autograd.grad(values, leaf, row, retain_graph=True, allow_unused=True)[0] for row in rows]
        found = None if each[0] is None else torch.stack(each)
    return leaf.new_zeros(len(rows), *leaf.shape) if found is None else found, values.detach()


def frame_norms(
    encode: Encode, frames: Tensor, jacobian: Tensor, norm: Norm, chunk: int, dtype: torch.dtype, maps: bool = True
) -> tuple[Tensor | None, Tensor]:
    """Norms of the gradients with respect to the frames, summed over the outputs.

    Args:
        encode: frames [N, H, W, C] to features [N, E].
        frames: uint8 or float [T, H, W, C].
        jacobian: of the outputs with respect to the features, float [K, T, E].
        norm: over the channels of a pixel and over whole frames.
        chunk: frames differentiated at a time.
        dtype: of the gradients.
        maps: whether norms of single pixels are wanted.

    Returns:
        ``(norms over channels [T, H, W] or None, norms over frames [T])``.
    """
    per_frame = jacobian.new_zeros(len(frames), dtype=dtype)
    per_pixel = jacobian.new_zeros(frames.shape[:3], dtype=dtype) if maps else None
    reached = jacobian.ne(0).any(-1).any(0).nonzero().squeeze(-1)
    for index in reached.split(chunk):
        part = frames[index].to(dtype).requires_grad_()
        features = encode(part)
        for row in jacobian[:, index].to(features):
            (gradient,) = torch.autograd.grad(features, part, row, retain_graph=True, materialize_grads=True)
            pixels = gradient.abs().sum(-1) if norm == "l1" else gradient.square().sum(-1)
            total = pixels.sum((1, 2))
            per_frame[index] += total.sqrt() if norm == "l2" else total
            if per_pixel is not None:
                per_pixel[index] += pixels.sqrt() if norm == "l2" else pixels
    return per_pixel, per_frame
