"""Triton kernels of the linear scan; ``scan_triton`` launches them, and says how much they move.
Imports triton.

One program owns one batch row and a block of features and walks through time in chunks: a chunk
[CHUNK, LANES] is scanned in parallel (``tl.associative_scan``), and the state behind it is carried
to the next in registers. What is scanned are the maps h -> a h + b, each with a flag: what stands
before a start is selected away, never multiplied by zero, so that a NaN or infinity does not come
through and the rounding of one episode has no part in the next.

The backward pass walks from the last step to the first, rows of a chunk in that order: the same
forward scan, over conj(a_{t+1}) and the flag of step t + 1. Complex numbers are pairs of reals, the
real part first.

Source: Blelloch (1990), "Prefix sums and their applications", section 1.5 (segmented scans).
"""

import triton
import triton.language as tl

__all__ = ["backward_complex", "backward_real", "forward_complex", "forward_real"]


@triton.jit
def join_real(a_left, b_left, flag_left, a, b, flag):
    """The map on the right after the one on the left, which a flag on the right hides."""
    return a_left * a, tl.where(flag != 0, b, a * b_left + b), flag_left | flag


@triton.jit
def join_complex(ar_left, ai_left, br_left, bi_left, flag_left, ar, ai, br, bi, flag):
    """:func:`join_real` on pairs."""
    closed = flag != 0
    return (
        ar_left * ar - ai_left * ai,
        ar_left * ai + ai_left * ar,
        tl.where(closed, br, ar * br_left - ai * bi_left + br),
        tl.where(closed, bi, ar * bi_left + ai * br_left + bi),
        flag_left | flag,
    )


@triton.jit
def _offsets(row, step, lane, strides):
    """Where the entries [CHUNK, LANES] of a tensor [B, T, F] stand."""
    return row * strides[0] + step[:, None] * strides[1] + lane[None, :] * strides[2]


@triton.jit
def _load_pairs(at, inside):
    """(real, imaginary parts), zero outside; both in one load, so that neighbours in memory are
    read together.
    """
    x = tl.load(
        tl.expand_dims(at, -1) + tl.arange(0, 2), mask=tl.expand_dims(inside, -1), other=0.0
    )
    return tl.split(x)


@triton.jit
def _store_pairs(at, real, imaginary, inside):
    """The reverse of :func:`_load_pairs`."""
    tl.store(
        tl.expand_dims(at, -1) + tl.arange(0, 2),
        tl.join(real, imaginary),
        mask=tl.expand_dims(inside, -1),
    )


@triton.jit
def _flags(start, row, step, inside, strides, LANES: tl.constexpr):
    """int32 [CHUNK, LANES], not 0 where an episode begins, and outside."""
    flag = tl.load(start + row * strides[0] + step * strides[1], mask=inside, other=1).to(tl.int32)
    return tl.broadcast_to(flag[:, None], (step.shape[0], LANES))


@triton.jit
def _last_row(x, CHUNK: tl.constexpr):
    """The last row of [CHUNK, LANES]."""
    return tl.sum(tl.where((tl.arange(0, CHUNK) == CHUNK - 1)[:, None], x, 0.0), axis=0)


@triton.jit
def _place(F, CHUNK: tl.constexpr, LANES: tl.constexpr):
    """Which batch row this program has, which features, which of them exist, and the rows of a
    chunk.
    """
    blocks = tl.cdiv(F, LANES)
    program = tl.program_id(0)
    lane = (program % blocks) * LANES + tl.arange(0, LANES)
    return (
        (program // blocks).to(tl.int64),
        lane.to(tl.int64),
        lane < F,
        tl.arange(0, CHUNK).to(tl.int64),
    )


@triton.jit
def forward_real(
    a,
    b,
    start,
    h0,
    out,
    T,
    F,
    a_by,
    b_by,
    start_by,
    h0_by,
    out_by,
    CHUNK: tl.constexpr,
    LANES: tl.constexpr,
):
    """``scan.scan``: reads a, b, start and h0, writes out; ``x_by`` are the strides of x."""
    row, lane, used, index = _place(F, CHUNK, LANES)
    state = tl.load(h0 + row * h0_by[0] + lane * h0_by[1], mask=used, other=0.0)
    for begin in range(0, T, CHUNK):
        step = begin + index
        inside = (step < T)[:, None] & used[None, :]
        factor = tl.load(a + _offsets(row, step, lane, a_by), mask=inside, other=0.0)
        x = tl.load(b + _offsets(row, step, lane, b_by), mask=inside, other=0.0)
        flag = _flags(start, row, step, step < T, start_by, LANES)
        enters = (index == 0)[:, None] & (flag == 0)
        x = tl.where(enters, factor * state[None, :] + x, x)
        _, h, _ = tl.associative_scan((factor, x, flag), 0, join_real)
        tl.store(out + _offsets(row, step, lane, out_by), h, mask=inside)
        state = _last_row(h, CHUNK)


@triton.jit
def backward_real(
    a, start, h0, h, grad, grad_a, grad_b, T, F, a_by, start_by, h0_by, h_by, grad_by, out_by,
    CHUNK: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """``scan.scan_backward``: reads a, start, h0, h and grad, writes grad_a and grad_b (strides
    ``out_by``).
    """
    row, lane, used, index = _place(F, CHUNK, LANES)
    initial = tl.load(h0 + row * h0_by[0] + lane * h0_by[1], mask=used, other=0.0)
    state = tl.zeros_like(initial)
    for begin in range(0, T, CHUNK):
        step = T - 1 - begin - index
        exists = step >= 0
        followed = (step >= 0) & (step < T - 1)
        inside = exists[:, None] & used[None, :]
        factor = tl.load(
            a + _offsets(row, step + 1, lane, a_by),
            mask=followed[:, None] & used[None, :],
            other=0.0,
        )
        g = tl.load(grad + _offsets(row, step, lane, grad_by), mask=inside, other=0.0)
        flag = _flags(start, row, step + 1, followed, start_by, LANES)
        enters = (index == 0)[:, None] & (flag == 0)
        g = tl.where(enters, factor * state[None, :] + g, g)
        _, g, _ = tl.associative_scan((factor, g, flag), 0, join_real)
        tl.store(grad_b + _offsets(row, step, lane, out_by), g, mask=inside)
        state = _last_row(g, CHUNK)

        before = tl.load(
            h + _offsets(row, step - 1, lane, h_by),
            mask=(step > 0)[:, None] & used[None, :],
            other=0.0,
        )
        before = tl.where((step == 0)[:, None], initial[None, :], before)
        begins = _flags(start, row, step, exists, start_by, LANES) != 0
        tl.store(
            grad_a + _offsets(row, step, lane, out_by),
            tl.where(begins, 0.0, g * before),
            mask=inside,
        )


@triton.jit
def forward_complex(
    a,
    b,
    start,
    h0,
    out,
    T,
    F,
    a_by,
    b_by,
    start_by,
    h0_by,
    out_by,
    CHUNK: tl.constexpr,
    LANES: tl.constexpr,
):
    """:func:`forward_real` on pairs: all but start have one more dimension, of 2 neighbours, not in
    ``x_by``.
    """
    row, lane, used, index = _place(F, CHUNK, LANES)
    sr, si = _load_pairs(h0 + 2 * (row * h0_by[0] + lane * h0_by[1]), used)
    for begin in range(0, T, CHUNK):
        step = begin + index
        inside = (step < T)[:, None] & used[None, :]
        ar, ai = _load_pairs(a + 2 * _offsets(row, step, lane, a_by), inside)
        xr, xi = _load_pairs(b + 2 * _offsets(row, step, lane, b_by), inside)
        flag = _flags(start, row, step, step < T, start_by, LANES)
        enters = (index == 0)[:, None] & (flag == 0)
        xr = tl.where(enters, ar * sr[None, :] - ai * si[None, :] + xr, xr)
        xi = tl.where(enters, ar * si[None, :] + ai * sr[None, :] + xi, xi)
        _, _, hr, hi, _ = tl.associative_scan((ar, ai, xr, xi, flag), 0, join_complex)
        _store_pairs(out + 2 * _offsets(row, step, lane, out_by), hr, hi, inside)
        sr = _last_row(hr, CHUNK)
        si = _last_row(hi, CHUNK)


@triton.jit
def backward_complex(
    a, start, h0, h, grad, grad_a, grad_b, T, F, a_by, start_by, h0_by, h_by, grad_by, out_by,
    CHUNK: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """:func:`backward_real` on pairs."""
    row, lane, used, index = _place(F, CHUNK, LANES)
    h0r, h0i = _load_pairs(h0 + 2 * (row * h0_by[0] + lane * h0_by[1]), used)
    sr = tl.zeros_like(h0r)
    si = tl.zeros_like(h0i)
    for begin in range(0, T, CHUNK):
        step = T - 1 - begin - index
        exists = step >= 0
        followed = (step >= 0) & (step < T - 1)
        inside = exists[:, None] & used[None, :]
        ar, ai = _load_pairs(
            a + 2 * _offsets(row, step + 1, lane, a_by), followed[:, None] & used[None, :]
        )
        ai = -ai
        gr, gi = _load_pairs(grad + 2 * _offsets(row, step, lane, grad_by), inside)
        flag = _flags(start, row, step + 1, followed, start_by, LANES)
        enters = (index == 0)[:, None] & (flag == 0)
        gr = tl.where(enters, ar * sr[None, :] - ai * si[None, :] + gr, gr)
        gi = tl.where(enters, ar * si[None, :] + ai * sr[None, :] + gi, gi)
        _, _, gr, gi, _ = tl.associative_scan((ar, ai, gr, gi, flag), 0, join_complex)
        _store_pairs(grad_b + 2 * _offsets(row, step, lane, out_by), gr, gi, inside)
        sr = _last_row(gr, CHUNK)
        si = _last_row(gi, CHUNK)

        hr, hi = _load_pairs(
            h + 2 * _offsets(row, step - 1, lane, h_by), (step > 0)[:, None] & used[None, :]
        )
        is_first = (step == 0)[:, None]
        hr = tl.where(is_first, h0r[None, :], hr)
        hi = tl.where(is_first, h0i[None, :], hi)
        begins = _flags(start, row, step, exists, start_by, LANES) != 0
        at = grad_a + 2 * _offsets(row, step, lane, out_by)
        _store_pairs(
            at,
            tl.where(begins, 0.0, gr * hr + gi * hi),
            tl.where(begins, 0.0, gi * hr - gr * hi),
            inside,
        )
