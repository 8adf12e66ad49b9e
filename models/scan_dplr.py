"""The matrix-valued linear recurrence with a diagonal plus low rank transition: RWKV-7's.

    S_t = diag(w_t) S_{t-1} - b_t (n_t^T S_{t-1}) + k_t v_t^T,        S [K, V]

:func:`dplr_scan` is one operator over time with a backward pass of its own, step by step on every
device; :func:`dplr_loop` is the same as a loop that can be read at a glance, and the oracle of the
tests. With one rate for all rows :func:`matrix_scan`, which runs in chunks, is the faster choice.
"""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from arcade_torch.models.sequential import Loads, one_by_one

__all__ = ["dplr_loop", "dplr_scan", "dplr_scan_backward"]


def dplr_loop(
    w: Tensor, b: Tensor, n: Tensor, k: Tensor, v: Tensor, start: Tensor, stored: Tensor
) -> Tensor:
    """The recurrence in plain torch operators: what acting runs, and the oracle of
    :func:`dplr_scan`.

    Args:
        w: float [B, T, K], and so are ``b``, ``n`` and ``k``.
        b: see ``w``.
        n: see ``w``.
        k: see ``w``.
        v: float [B, T, V].
        start: bool [B, T], where a state is loaded; set at index 0.
        stored: what is loaded, [B, T, K, V] or [B, 1, K, V]; see :class:`Loads`.

    Returns:
        The state after each step [B, T, K, V].
    """
    if stored.shape[1] < start.shape[1]:
        stored = F.pad(stored, (0, 0, 0, 0, 0, start.shape[1] - 1))
    states = []
    state = stored[:, 0]
    for t, begins in enumerate(start[..., None, None].unbind(1)):
        if t > 0:
            state = torch.where(begins, stored[:, t], state)
        recalled = n[:, t, None] @ state
        written = k[:, t, :, None] * v[:, t, None] - b[:, t, :, None] * recalled
        state = w[:, t, :, None] * state + written
        states.append(state)
    return torch.stack(states, dim=1)


@torch.library.custom_op("arcade_torch::dplr_scan", mutates_args=())
def dplr_scan(
    w: Tensor, b: Tensor, n: Tensor, k: Tensor, v: Tensor, start: Tensor, stored: Tensor
) -> Tensor:
    """:func:`dplr_loop` as one operator."""
    loads = Loads(start, stored)
    states = k.unsqueeze(-1) * v.unsqueeze(-2)  # what is written; the rest comes in place
    state = loads.first
    columns = zip(
        w.unsqueeze(-1).unbind(1),
        b.unsqueeze(-1).unbind(1),
        n.unsqueeze(-2).unbind(1),
        states.unbind(1),
        strict=True,
    )
    for t, (keep, erase, key, after) in enumerate(columns):
        state = loads.apply(t, state)
        after.baddbmm_(erase, torch.bmm(key, state), alpha=-1)
        state = after.addcmul_(keep, state)
    return states


@torch.library.custom_op("arcade_torch::dplr_scan_backward", mutates_args=())
def dplr_scan_backward(
    w: Tensor,
    b: Tensor,
    n: Tensor,
    k: Tensor,
    v: Tensor,
    start: Tensor,
    stored: Tensor,
    states: Tensor,
    grad: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of :func:`dplr_scan` with respect to its float arguments, from what it took and
    returned, and the gradient [B, T, K, V] that arrives at the states.
    """
    loads = Loads(start, stored)
    d_states = grad.clone(memory_format=torch.contiguous_format)
    d_stored = stored.new_zeros(stored.shape)
    d_recalled = v.new_empty(v.shape)
    columns = zip(
        w.unsqueeze(-1).unbind(1),
        b.unsqueeze(-2).unbind(1),
        n.unsqueeze(-1).unbind(1),
        d_states.unbind(1),
        d_recalled.unsqueeze(-2).unbind(1),
        strict=True,
    )
    carried = torch.zeros_like(states[:, 0])
    for t, (keep, erase, key, d_state, d_of_key) in reversed(list(enumerate(columns))):
        d_state += carried
        d_of_key.copy_(torch.bmm(erase, d_state))
        carried = torch.mul(keep, d_state).baddbmm_(key, d_of_key, alpha=-1)
        loads.collect(t, carried, d_stored)
    before = loads.before(states)
    d_w = (d_states * before).sum(-1)
    d_b = -(d_states @ (n.unsqueeze(-2) @ before).mT).squeeze(-1)
    d_n = -(before @ d_recalled.unsqueeze(-1)).squeeze(-1)
    d_k = (d_states @ v.unsqueeze(-1)).squeeze(-1)
    d_v = (k.unsqueeze(-2) @ d_states).squeeze(-2)
    return d_w, d_b, d_n, d_k, d_v, d_stored


@dplr_scan.register_fake
def _(
    w: Tensor, b: Tensor, n: Tensor, k: Tensor, v: Tensor, start: Tensor, stored: Tensor
) -> Tensor:
    return k.new_empty(*k.shape, v.shape[-1])


@dplr_scan_backward.register_fake
def _(
    w: Tensor, b: Tensor, n: Tensor, k: Tensor, v: Tensor, start: Tensor, stored: Tensor, *_: Any
) -> Any:
    return tuple(x.new_empty(x.shape) for x in (w, b, n, k, v, stored))


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs, output)


def _differentiate(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    *gradients, to_stored = dplr_scan_backward(*ctx.saved_tensors, grad)
    return *gradients, None, to_stored


dplr_scan.register_autograd(_differentiate, setup_context=_save)
dplr_scan.register_vmap(one_by_one(dplr_scan))
dplr_scan_backward.register_vmap(one_by_one(dplr_scan_backward))
