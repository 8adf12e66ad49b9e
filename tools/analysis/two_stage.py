"""Gradients of a decision with respect to every frame before it, in two stages.

The encoder works frame by frame, so memory and head are differentiated once, with respect to the features (giving J,
outputs x steps x features), and J is then pulled back through the encoder in chunks of frames. The cost is one backward
pass of the encoder for each frame and output, whatever the memory model; memory use is that of one chunk, and for the
paper's encoder a tape smaller than the frames are as floats. Frames whose row of J is exactly zero have no gradient and
are skipped.
"""

from collections.abc import Iterable
from functools import partial, reduce
from typing import Any, Literal

import torch
from torch import Tensor

from arcade_torch.models.pullback import Pull, recorded_twice
from arcade_torch.models.tiles import as_pictures
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

    One forward pass, and one backward pass for all outputs at once (vmap). If the memory uses an operator that cannot
    be batched this way, one backward pass for each output.

    Args:
        policy: whose ``remember`` is differentiated.
        scalars: what of its outputs.
        features: float [T, E].
        last_action: int64 [T].
        is_init: bool [T].
        state: before the first frame, batch of one; None for the initial one.
        reduce: ``sum`` adds the outputs up before differentiating.

    Returns:
        ``(J [K, T, E] (K = 1 for "sum"), outputs at the last step [A])``.
    """
    leaf = features.clone().requires_grad_()
    start = policy.initial_state(1) if state is None else state
    out, _ = policy.remember(leaf[None], last_action[None], is_init[None], start)
    chosen = scalars(out[:, -1])[0]
    rows = torch.ones_like(chosen)[None] if reduce == "sum" else torch.eye(len(chosen)).to(chosen)
    return pulled_rows(chosen, leaf, rows), chosen.detach()


def pulled_rows(y: Tensor, x: Tensor, rows: Tensor) -> Tensor:
    """Gradients of products of rows [K, *y] with y with respect to x, [K, *x]; zeros if y does not depend on x."""
    if not y.requires_grad:
        return x.new_zeros(len(rows), *x.shape)
    try:
        (found,) = torch.autograd.grad(y, x, rows, retain_graph=True, is_grads_batched=True, allow_unused=True)
    except RuntimeError:  # an operator without a batching rule
        each = [torch.autograd.grad(y, x, row, retain_graph=True, allow_unused=True)[0] for row in rows]
        found = None if each[0] is None else torch.stack(each)
    return x.new_zeros(len(rows), *x.shape) if found is None else found


def record_all(policy: Policy, frames: Tensor, chunk: int, dtype: torch.dtype) -> tuple[Tensor, list[Pull]]:
    """Features [T, E] of frames [T, H, W, C], without gradients, and the way back for each ``chunk`` of them."""
    record = policy.record or partial(recorded_twice, policy.encode)
    parts = [record(part, dtype) for part in frames.split(chunk)]
    return torch.cat([features for features, _ in parts]), [pull for _, pull in parts]


def encoder_stage(
    pulls: list[Pull],
    shape: torch.Size,
    cotangents: Tensor,
    norm: Norm,
    chunk: int,
    dtype: torch.dtype,
    maps: bool = True,
) -> tuple[Tensor | None, Tensor]:
    """Pull J back through the encoder chunk by chunk and reduce at once.

    Args:
        pulls: one for each chunk of frames, see `record_all`.
        shape: of the frames, [T, H, W, C].
        cotangents: J, float [K, T, E].
        norm: see `norms`.
        chunk: frames at once.
        dtype: of the gradients.
        maps: whether single pixels are wanted.

    Returns:
        ``(sums over outputs of the norm over channels [T, H, W] or None, of the norm over the frame [T])``.
    """
    totals = cotangents.new_zeros(shape[0], dtype=dtype)
    pixels = cotangents.new_zeros(shape[:-1], dtype=dtype) if maps else None
    alive = cotangents.ne(0).any(-1).any(0)
    for start, pull in zip(range(0, shape[0], chunk), pulls, strict=True):
        index = alive[start : start + chunk].nonzero().squeeze(-1)
        done = 0
        for gradients in pull(cotangents[:, start + index].to(dtype), index) if len(index) else ():
            per_pixel, per_frame = norms(gradients, norm, maps)
            where = start + index[done : done + len(per_frame)]
            done += len(per_frame)
            totals[where] = per_frame
            if pixels is not None and per_pixel is not None:
                pixels[where] = as_pictures(per_pixel, *shape[1:3])
    return pixels, totals


def norms(gradients: Tensor, norm: Norm, maps: bool = True) -> tuple[Tensor | None, Tensor]:
    """Norms of gradients [K, n, C, ...], added up over K, whatever the dimensions of a picture are.

    Returns:
        ``(over channels [n, ...] or None without ``maps``, over whole frames [n])``.
    """
    if norm == "l2":
        size = gradients.square()
        per_frame = size.sum(tuple(range(2, size.ndim))).sqrt().sum(0)
        return (_added(_added(size.unbind(2)).sqrt().unbind(0)) if maps else None), per_frame
    rows = (row.abs() if norm == "l1" else row.square() for row in gradients)
    per_pixel = _added(_added(rows).unbind(1))
    return (per_pixel if maps else None), per_pixel.flatten(1).sum(1)


def _added(parts: Iterable[Tensor]) -> Tensor:
    """The sum of tensors, in the memory of the first: `Tensor.sum` is slow where channels lie innermost."""
    return reduce(Tensor.add_, parts)


def encode_all(encode: Encode, frames: Tensor, chunk: int, dtype: torch.dtype) -> Tensor:
    """Features [T, E] of frames [T, H, W, C], without gradients, ``chunk`` frames at once."""
    with torch.no_grad():
        return torch.cat([encode(part.to(dtype)) for part in frames.split(chunk)])
