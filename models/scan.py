"""The first-order linear scan h_t = a_t h_{t-1} + b_t: everything a linear recurrent memory does
over time.

:func:`linear_scan` is the function to use. Below stand the operators that do the work, forward and
backward, registered with torch (autograd, vmap, compile), with back ends by device: a serial loop,
in place over time and vectorised over batch and features; on CUDA the kernels of ``scan_triton``,
or, without Triton or for other dtypes, the doubling form, ``log2(T)`` passes over the whole tensor.
The backward pass is the same recurrence run the other way on conj(a) shifted by one; its own
derivative is again a scan, so gradients of any order exist.

Inside the operators conj() is spelled conj_physical(): compiled code (torch 2.13, aot and inductor)
calls them in a way in which the lazy conj() is silently lost.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from arcade_torch.models.scan_triton import runs_triton, scan_backward_triton, scan_triton

__all__ = ["back_end", "linear_scan", "scan", "scan_backward"]


def linear_scan(
    a: Tensor, b: Tensor, start: Tensor | None = None, h0: Tensor | None = None
) -> Tensor:
    """Solve ``h_t = a_t h_{t-1} + b_t`` over dimension 1, starting afresh wherever ``start`` is
    set.

    Works under autograd (to any order, batched gradients too), ``torch.vmap`` and
    ``torch.compile(fullgraph=True)``. ``torch.func.grad`` does not support operators registered
    through ``torch.library``; use ``torch.autograd.grad``.

    Args:
        a: float, complex or int, broadcastable to ``[B, T, ...]``: the factors (a constant
            ``[...]`` is fine).
        b: float, complex or int ``[B, T, ...]``: the inputs.
        start: bool ``[B, T]`` or None; True where an episode begins: ``h_{t-1}`` is not looked at
            there, be it NaN.
        h0: the state before index 0, ``[B, ...]`` (one dimension less than ``b``; dropped where
            ``start[:, 0]``); or one state *per position*, ``[B, T, ...]``: index 0 and every start
            then load the state that stands at their own position (how a replay buffer stores
            sequences cut in mid-episode). None means zeros.

    Returns:
        ``[B, T, ...]``, every state, in the common dtype of ``a`` and ``b``.

    Raises:
        ValueError: shapes do not fit, ``start`` is not bool ``[B, T]``, ``a`` and ``b`` are bool,
            ``h0`` is complex where they are not, or one of them is no tensor.

    Source: Blelloch (1990), "Prefix sums and their applications", section 1.4; resets as in arXiv
        2303.03982.

    Example:
        >>> a, b = torch.full((1, 4, 1), 0.5), torch.ones(1, 4, 1)
        >>> linear_scan(a, b).flatten().tolist()
        [1.0, 1.5, 1.75, 1.875]
        >>> linear_scan(a, b, start=torch.tensor([[False, False, True, False]])).flatten().tolist()
        [1.0, 1.5, 1.0, 1.5]
    """
    _check_tensors(a, b, start, h0)
    if a.dtype != b.dtype:
        dtype = torch.promote_types(a.dtype, b.dtype)
        a = a.to(dtype)
        b = b.to(dtype)
    if h0 is not None and h0.dtype != b.dtype:
        h0 = h0.to(b.dtype)
    _check(a, b, start, h0)
    if h0 is not None and h0.ndim == b.ndim:
        b, start = _load_stored_states(a, b, start, h0)
        h0 = None
    if b.shape[1] == 1:  # acting: no operator, no loop
        return b.clone() if h0 is None else torch.addcmul(b, a, _keep(h0, start).unsqueeze(1))
    if h0 is None:
        h0 = b.new_zeros(b.shape[:1] + b.shape[2:])
    return scan(a.expand(b.shape), b, start, h0)  # type: ignore[no-any-return]


def _check_tensors(a: Any, b: Any, start: Any, h0: Any) -> None:
    """Raise ValueError unless the types are those that :func:`linear_scan` documents."""
    for name, value in (("a", a), ("b", b)):
        if not isinstance(value, Tensor):
            raise ValueError(f"{name} must be a tensor, got a {type(value).__name__}")
    for name, value in (("start", start), ("h0", h0)):
        if value is not None and not isinstance(value, Tensor):
            raise ValueError(f"{name} must be a tensor or None, got a {type(value).__name__}")
    is_complex = a.is_complex() or b.is_complex()
    if a.dtype == torch.bool and b.dtype == torch.bool:
        raise ValueError("a and b must be floats, complex or whole numbers, got torch.bool")
    if h0 is not None and h0.is_complex() and not is_complex:
        raise ValueError(
            f"h0 is complex, and a and b are not ({a.dtype} and {b.dtype}): cast one of them"
        )


def _check(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor | None) -> None:
    """Raise ValueError unless the shapes are those that :func:`linear_scan` documents."""
    if b.ndim < 2 or b.shape[1] == 0:
        raise ValueError(f"b must be [B, T, ...] with T >= 1, got shape {list(b.shape)}")
    sizes = zip(reversed(a.shape), reversed(b.shape), strict=False)
    broadcasts = a.ndim <= b.ndim and all(of_a in (1, of_b) for of_a, of_b in sizes)
    if not broadcasts:
        raise ValueError(
            f"a of shape {list(a.shape)} does not broadcast to b of shape {list(b.shape)}"
        )
    if start is not None and (start.shape != b.shape[:2] or start.dtype != torch.bool):
        raise ValueError(
            f"start must be bool {list(b.shape[:2])}, got {start.dtype} {list(start.shape)}; "
            "is_init of shape [B, T, 1] needs squeeze(-1)"
        )
    if h0 is not None and h0.shape != b.shape and h0.shape != b.shape[:1] + b.shape[2:]:
        raise ValueError(
            f"h0 must be [B, ...] or [B, T, ...] for b of shape {list(b.shape)}, got "
            f"{list(h0.shape)}"
        )


def _keep(h0: Tensor, start: Tensor | None) -> Tensor:
    """h0 where the first step does not begin an episode; selected, so that a stale NaN does not
    come through.
    """
    if start is None:
        return h0
    begins = start[:, 0].reshape(-1, *(1,) * (h0.ndim - 1))
    return h0.masked_fill(begins, 0)


def _load_stored_states(
    a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor
) -> tuple[Tensor, Tensor]:
    """Fold one stored state per position into b; returns the new (b, start)."""
    begins = (torch.arange(b.shape[1], device=b.device) == 0).expand(b.shape[:2])
    if start is not None:
        begins = begins | start
    mask = begins.reshape(begins.shape + (1,) * (b.ndim - 2))
    return b + a * h0.masked_fill(~mask, 0), begins


_forced: str | None = None
"""The back end that :func:`back_end` has chosen; None: that of the device."""


@torch.library.custom_op("arcade_torch::linear_scan", mutates_args=())
def scan(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor) -> Tensor:
    """h_t = a_t (0 if start_t else h_{t-1}) + b_t, all states.

    Args:
        a: float or complex [B, T, ...].
        b: like a.
        start: bool [B, T] or None.
        h0: [B, ...], the state before index 0.

    Returns:
        [B, T, ...].
    """
    return BACK_ENDS[_back_end_of(b)][0](a, b, start, h0)


def scan_serial(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor) -> Tensor:
    """A loop over time, in place."""
    starts = _start_masks(start, b.ndim)
    out = b.clone(memory_format=torch.contiguous_format)
    h = h0
    for t, (a_t, out_t) in enumerate(zip(a.unbind(1), out.unbind(1), strict=True)):
        if t in starts:
            h = h.masked_fill(starts[t], 0)
        h = out_t.addcmul_(a_t, h)
    return out


@torch.library.custom_op("arcade_torch::linear_scan_backward", mutates_args=())
def scan_backward(
    a: Tensor, start: Tensor | None, h0: Tensor, h: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of :func:`scan` with respect to a and b (that of h0 is ``conj(a_0) grad_b_0``).

    Args:
        a: float or complex [B, T, ...], the factors of the forward pass.
        start: bool [B, T] or None.
        h0: [B, ...].
        h: [B, T, ...], what :func:`scan` returned.
        grad: [B, T, ...], the gradient that arrives at h.

    Returns:
        (grad_a, grad_b): grad_b_t = grad_t + conj(a_{t+1}) grad_b_{t+1}, where nothing crosses a
        start, and grad_a_t = grad_b_t conj(h_{t-1}), zero at a start.
    """
    return BACK_ENDS[_back_end_of(grad)][1](a, start, h0, h, grad)


def scan_backward_serial(
    a: Tensor, start: Tensor | None, h0: Tensor, h: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor]:
    """The backward pass as a loop."""
    starts = _start_masks(start, a.ndim)
    grad_b = grad.clone(memory_format=torch.contiguous_format)
    factors = torch.conj_physical(a).unbind(1)
    rows = grad_b.unbind(1)
    for t in range(len(rows) - 1, 0, -1):
        after = rows[t].masked_fill(starts[t], 0) if t in starts else rows[t]
        rows[t - 1].addcmul_(factors[t], after)
    grad_a = torch.cat((h0.unsqueeze(1), h[:, :-1]), dim=1).conj_physical_().mul_(grad_b)
    if start is not None and starts:  # by index: masking the whole tensor costs as much as the scan
        grad_a.flatten(0, 1).index_fill_(0, start.flatten().nonzero().squeeze(-1), 0)
    return grad_a, grad_b


def _start_masks(start: Tensor | None, ndim: int) -> dict[int, Tensor]:
    """For each step at which some row begins an episode: which rows, bool [B, 1, ...] with ndim - 1
    dimensions.
    """
    if start is None:
        return {}
    masks = start.reshape(start.shape + (1,) * (ndim - 2))
    return {t: masks[:, t] for t, begins in enumerate(start.any(0).tolist()) if begins}


def scan_doubling(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor) -> Tensor:
    """Parallel form (Hillis and Steele 1986): after the pass with shift s an entry covers the 2s
    steps up to it.
    """
    closed = _closed_at_starts(start, b)
    first = torch.where(closed[:, 0], b[:, 0], torch.addcmul(b[:, 0], a[:, 0], h0))
    h = torch.cat([first.unsqueeze(1), b[:, 1:]], dim=1)
    shift = 1
    steps = b.shape[1]
    while shift < steps:
        joined = torch.addcmul(h[:, shift:], a[:, shift:], h[:, :-shift])
        h = torch.cat([h[:, :shift], torch.where(closed[:, shift:], h[:, shift:], joined)], dim=1)
        a = torch.cat([a[:, :shift], a[:, shift:] * a[:, :-shift]], dim=1)
        closed = torch.cat([closed[:, :shift], closed[:, shift:] | closed[:, :-shift]], dim=1)
        shift *= 2
    return h


def scan_backward_doubling(
    a: Tensor, start: Tensor | None, h0: Tensor, h: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor]:
    """The backward pass in the doubling form: a forward scan over flipped time."""
    # the last step has none behind it; a factor of another step may be NaN, and 0 * NaN is NaN
    none = torch.zeros_like(a[:, :1])
    shifted = torch.conj_physical(torch.cat([none, a[:, 1:].flip(1)], dim=1))
    begins = None
    if start is not None:
        begins = torch.cat([torch.zeros_like(start[:, :1]), start[:, 1:].flip(1)], dim=1)
    grad_b = scan_doubling(shifted, grad.flip(1), begins, torch.zeros_like(h0)).flip(1).contiguous()
    before = torch.cat([h0.unsqueeze(1), h[:, :-1]], dim=1)
    grad_a = torch.where(_closed_at_starts(start, a), 0, grad_b * torch.conj_physical(before))
    return grad_a, grad_b


def _closed_at_starts(start: Tensor | None, steps: Tensor) -> Tensor:
    """bool [B, T, 1, ...]: True where the previous state must not be looked at."""
    if start is None:
        start = torch.zeros(steps.shape[:2], dtype=torch.bool, device=steps.device)
    return start.reshape(start.shape + (1,) * (steps.ndim - 2))


BACK_ENDS = {
    "serial": (scan_serial, scan_backward_serial),
    "doubling": (scan_doubling, scan_backward_doubling),
    "triton": (scan_triton, scan_backward_triton),
}
"""Name -> what solves forward and backward."""


def _back_end_of(x: Tensor) -> str:
    if _forced is not None:
        return _forced
    if not x.is_cuda:
        return "serial"
    return "triton" if runs_triton(x) else "doubling"


@contextmanager
def back_end(name: str) -> Iterator[None]:
    """Inside, every scan of this process runs by one back end, whatever the device: for tests and
    benchmarks.

    Args:
        name: key of `BACK_ENDS`. "triton" on a CPU needs ``TRITON_INTERPRET=1`` in the environment
            from the start.

    Raises:
        ValueError: there is no such back end.

    Example:
        >>> with back_end("doubling"):
        ...     scan(torch.full((1, 3), 0.5), torch.ones(1, 3), None, torch.zeros(1)).tolist()
        [[1.0, 1.5, 1.75]]
    """
    global _forced
    if name not in BACK_ENDS:
        raise ValueError(f"no back end {name!r}; there are {', '.join(BACK_ENDS)}")
    before = _forced
    _forced = name
    try:
        yield
    finally:
        _forced = before


# Shapes, derivatives and vmap rules.


@scan.register_fake
def _(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor) -> Tensor:
    return torch.empty_like(b, memory_format=torch.contiguous_format)


@scan_backward.register_fake
def _(
    a: Tensor, start: Tensor | None, h0: Tensor, h: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor]:
    template = torch.empty_like(grad, memory_format=torch.contiguous_format)
    return template, torch.empty_like(template)


def _save_scan(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    a, _, start, h0 = inputs
    ctx.save_for_backward(a, start, h0, output)


def _differentiate_scan(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    a, start, h0, h = ctx.saved_tensors
    grad_a, grad_b = scan_backward(a, start, h0, h, grad)
    grad_h0 = None
    if ctx.needs_input_grad[3]:
        grad_h0 = grad_b[:, 0] * a[:, 0].conj()
        if start is not None:
            grad_h0 = grad_h0.masked_fill(_closed_at_starts(start, a)[:, 0], 0)
    return grad_a, grad_b, None, grad_h0


def _save_backward(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    a, start, h0, h, _ = inputs
    ctx.save_for_backward(a, start, h0, h, output[1])


def _differentiate_backward(
    ctx: Any, to_grad_a: Tensor, to_grad_b: Tensor
) -> tuple[Tensor | None, ...]:
    """Derivative of grad_b = L^H grad and grad_a = grad_b conj(before), where L is the scan without
    h0.
    """
    a, start, h0, h, grad_b = ctx.saved_tensors
    closed = _closed_at_starts(start, a)
    to_grad_a = to_grad_a.masked_fill(closed, 0)
    before = torch.cat([h0.unsqueeze(1), h[:, :-1]], dim=1).masked_fill(closed, 0)
    to_grad = scan(a, to_grad_b + to_grad_a * before, start, torch.zeros_like(h0))
    to_before = grad_b * to_grad_a.conj()
    last = torch.zeros_like(h0).unsqueeze(1)
    to_a = torch.cat([last, to_grad[:, :-1].conj() * grad_b[:, 1:]], dim=1).masked_fill(closed, 0)
    return to_a, None, to_before[:, 0], torch.cat([to_before[:, 1:], last], dim=1), to_grad


scan.register_autograd(_differentiate_scan, setup_context=_save_scan)
scan_backward.register_autograd(_differentiate_backward, setup_context=_save_backward)


def _fold(
    size: int, dims: tuple[int | None, ...], args: tuple[Tensor | None, ...]
) -> list[Tensor | None]:
    """Move each argument's vmapped dimension into the batch (an argument without one is
    repeated).
    """

    def fold(x: Tensor | None, dim: int | None) -> Tensor | None:
        if x is None:
            return None
        x = x.unsqueeze(0).expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
        return x.reshape(-1, *x.shape[2:])

    return [fold(x, dim) for x, dim in zip(args, dims, strict=True)]


@scan.register_vmap
def _(info: Any, in_dims: tuple[int | None, ...], *args: Tensor | None) -> tuple[Tensor, int]:
    out = scan(*_fold(info.batch_size, in_dims, args))
    return out.unflatten(0, (info.batch_size, -1)), 0


@scan_backward.register_vmap
def _(
    info: Any, in_dims: tuple[int | None, ...], *args: Tensor | None
) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
    grad_a, grad_b = scan_backward(*_fold(info.batch_size, in_dims, args))
    sizes = (info.batch_size, -1)
    return (grad_a.unflatten(0, sizes), grad_b.unflatten(0, sizes)), (0, 0)
