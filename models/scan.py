"""The first-order linear scan h_t = a_t h_{t-1} + b_t: everything a linear recurrent memory does over time.

:func:`linear_scan` is the function to use; :func:`linear_scan_loop` beside it is the same thing as a loop that can be
read at a glance, and the oracle of the tests. The operators that do the work stand in ``scan_ops``.
"""

import torch
from torch import Tensor

from arcade_torch.models.scan_ops import scan

__all__ = ["linear_scan", "linear_scan_loop"]


def linear_scan(a: Tensor, b: Tensor, start: Tensor | None = None, h0: Tensor | None = None) -> Tensor:
    """Solve ``h_t = a_t h_{t-1} + b_t`` over dimension 1, starting afresh wherever ``start`` is set.

    Works under autograd (to any order, batched gradients too), ``torch.vmap`` and ``torch.compile(fullgraph=True)``.
    ``torch.func.grad`` does not support operators registered through ``torch.library``; use ``torch.autograd.grad``.

    Args:
        a: float or complex, broadcastable to ``[B, T, ...]``: the factors (a constant ``[...]`` is fine).
        b: float or complex ``[B, T, ...]``: the inputs.
        start: bool ``[B, T]`` or None; True where an episode begins: ``h_{t-1}`` is not looked at there, be it NaN.
        h0: the state before index 0, ``[B, ...]`` (one dimension less than ``b``; dropped where ``start[:, 0]``);
            or one state *per position*, ``[B, T, ...]``: index 0 and every start then load the state that stands
            at their own position (how a replay buffer stores sequences cut in mid-episode). None means zeros.

    Returns:
        ``[B, T, ...]``, every state, in the common dtype of ``a`` and ``b``.

    Raises:
        ValueError: shapes do not fit, or ``start`` is not bool ``[B, T]``.

    Source: Blelloch (1990), "Prefix sums and their applications", section 1.4; resets as in arXiv 2303.03982.

    Example:
        >>> a, b = torch.full((1, 4, 1), 0.5), torch.ones(1, 4, 1)
        >>> linear_scan(a, b).flatten().tolist()
        [1.0, 1.5, 1.75, 1.875]
        >>> linear_scan(a, b, start=torch.tensor([[False, False, True, False]])).flatten().tolist()
        [1.0, 1.5, 1.0, 1.5]
    """
    if a.dtype != b.dtype:
        dtype = torch.promote_types(a.dtype, b.dtype)
        a, b = a.to(dtype), b.to(dtype)
    if h0 is not None and h0.dtype != b.dtype:
        h0 = h0.to(b.dtype)
    _check(a, b, start, h0)
    if h0 is not None and h0.ndim == b.ndim:
        b, start = _load_stored_states(a, b, start, h0)
        h0 = None
    if b.shape[1] == 1:  # acting: no operator, no loop
        return b if h0 is None else torch.addcmul(b, a, _keep(h0, start).unsqueeze(1))
    if h0 is None:
        h0 = b.new_zeros(b.shape[:1] + b.shape[2:])
    return scan(a.expand(b.shape), b, start, h0)  # type: ignore[no-any-return]


def linear_scan_loop(a: Tensor, b: Tensor, start: Tensor | None = None, h0: Tensor | None = None) -> Tensor:
    """The same function as :func:`linear_scan`, step by step (slow)."""
    a = a.expand(b.shape)
    begins = torch.zeros(b.shape[:2], dtype=torch.bool) if start is None else start.clone()
    stored = torch.zeros_like(b)
    h = torch.zeros_like(b[:, 0])
    if h0 is not None and h0.ndim == b.ndim:
        stored = h0
        begins[:, 0] = True
    elif h0 is not None:
        h = h0
    states = []
    for t in range(b.shape[1]):
        h = torch.where(begins[:, t].reshape(-1, *[1] * (h.ndim - 1)), stored[:, t], h)
        h = a[:, t] * h + b[:, t]
        states.append(h)
    return torch.stack(states, dim=1)


def _check(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor | None) -> None:
    """Raise ValueError unless the shapes are those that :func:`linear_scan` documents."""
    if b.ndim < 2 or b.shape[1] == 0:
        raise ValueError(f"b must be [B, T, ...] with T >= 1, got shape {list(b.shape)}")
    fits = all(n in (1, m) for n, m in zip(a.shape[::-1], b.shape[::-1], strict=False)) and a.ndim <= b.ndim
    if not fits:
        raise ValueError(f"a of shape {list(a.shape)} does not broadcast to b of shape {list(b.shape)}")
    if start is not None and (start.shape != b.shape[:2] or start.dtype != torch.bool):
        raise ValueError(
            f"start must be bool {list(b.shape[:2])}, got {start.dtype} {list(start.shape)}; "
            "is_init of shape [B, T, 1] needs squeeze(-1)"
        )
    if h0 is not None and h0.shape != b.shape and h0.shape != b.shape[:1] + b.shape[2:]:
        raise ValueError(f"h0 must be [B, ...] or [B, T, ...] for b of shape {list(b.shape)}, got {list(h0.shape)}")


def _keep(h0: Tensor, start: Tensor | None) -> Tensor:
    """h0 where the first step does not begin an episode; selected, so that a stale NaN does not come through."""
    return h0 if start is None else h0.masked_fill(start[:, :1].reshape((-1,) + (1,) * (h0.ndim - 1)), 0)


def _load_stored_states(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor) -> tuple[Tensor, Tensor]:
    """Fold one stored state per position into b; returns the new (b, start)."""
    begins = (torch.arange(b.shape[1], device=b.device) == 0).expand(b.shape[:2])
    if start is not None:
        begins = begins | start
    mask = begins.reshape(begins.shape + (1,) * (b.ndim - 2))
    return b + a * h0.masked_fill(~mask, 0), begins
