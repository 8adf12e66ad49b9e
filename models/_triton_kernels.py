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
def _load_initial_pairs(h0, row, lane, used, strides):
    """(real, imaginary parts) [LANES] of the state before the first step."""
    at = h0 + 2 * (row * strides[0] + lane * strides[1])
    pairs = tl.load(at[:, None] + tl.arange(0, 2)[None, :], mask=used[:, None], other=0.0)
    return tl.split(pairs)


@triton.jit
def _parts(row, step, exists, F, strides, LANES: tl.constexpr):
    """Offsets of the parts of the program's lanes, real and imaginary in turn, and which exist:
    both [CHUNK, 2 * LANES].

    Where lanes are neighbours, so are these offsets, which lets a thread move four floats at a
    time.
    """
    first = ((tl.program_id(0) % tl.cdiv(F, LANES)) * LANES).to(tl.int64)
    part = 2 * first + tl.arange(0, 2 * LANES)
    column = part
    if strides[2] != 1:
        column = 2 * (part // 2) * strides[2] + part % 2
    offsets = 2 * (row * strides[0] + step[:, None] * strides[1]) + column[None, :]
    return offsets, exists[:, None] & (part < 2 * F)[None, :]


@triton.jit
def _load_pairs(x, row, step, exists, F, strides, LANES: tl.constexpr):
    """(real, imaginary parts) [CHUNK, LANES] of x [B, T, F, 2], zero outside."""
    offsets, inside = _parts(row, step, exists, F, strides, LANES)
    pairs = tl.load(x + offsets, mask=inside, other=0.0)
    return tl.split(tl.reshape(pairs, (step.shape[0], LANES, 2)))


@triton.jit
def _store_pairs(x, real, imaginary, row, step, exists, F, strides, LANES: tl.constexpr):
    """The reverse of :func:`_load_pairs`."""
    offsets, inside = _parts(row, step, exists, F, strides, LANES)
    pairs = tl.reshape(tl.join(real, imaginary), (step.shape[0], 2 * LANES))
    tl.store(x + offsets, pairs, mask=inside)


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
    sr, si = _load_initial_pairs(h0, row, lane, used, h0_by)
    for begin in range(0, T, CHUNK):
        step = begin + index
        exists = step < T
        ar, ai = _load_pairs(a, row, step, exists, F, a_by, LANES)
        xr, xi = _load_pairs(b, row, step, exists, F, b_by, LANES)
        flag = _flags(start, row, step, exists, start_by, LANES)
        enters = (index == 0)[:, None] & (flag == 0)
        xr = tl.where(enters, ar * sr[None, :] - ai * si[None, :] + xr, xr)
        xi = tl.where(enters, ar * si[None, :] + ai * sr[None, :] + xi, xi)
        _, _, hr, hi, _ = tl.associative_scan((ar, ai, xr, xi, flag), 0, join_complex)
        _store_pairs(out, hr, hi, row, step, exists, F, out_by, LANES)
        sr = _last_row(hr, CHUNK)
        si = _last_row(hi, CHUNK)


@triton.jit
def backward_complex(
    a, start, h0, h, grad, grad_a, grad_b, T, F, a_by, start_by, h0_by, h_by, grad_by, out_by,
    CHUNK: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """:func:`backward_real` on pairs."""
    row, lane, used, index = _place(F, CHUNK, LANES)
    h0r, h0i = _load_initial_pairs(h0, row, lane, used, h0_by)
    sr = tl.zeros_like(h0r)
    si = tl.zeros_like(h0i)
    for begin in range(0, T, CHUNK):
        step = T - 1 - begin - index
        exists = step >= 0
        followed = (step >= 0) & (step < T - 1)
        ar, ai = _load_pairs(a, row, step + 1, followed, F, a_by, LANES)
        ai = -ai
        gr, gi = _load_pairs(grad, row, step, exists, F, grad_by, LANES)
        flag = _flags(start, row, step + 1, followed, start_by, LANES)
        enters = (index == 0)[:, None] & (flag == 0)
        gr = tl.where(enters, ar * sr[None, :] - ai * si[None, :] + gr, gr)
        gi = tl.where(enters, ar * si[None, :] + ai * sr[None, :] + gi, gi)
        _, _, gr, gi, _ = tl.associative_scan((ar, ai, gr, gi, flag), 0, join_complex)
        _store_pairs(grad_b, gr, gi, row, step, exists, F, out_by, LANES)
        sr = _last_row(gr, CHUNK)
        si = _last_row(gi, CHUNK)

        hr, hi = _load_pairs(h, row, step - 1, step > 0, F, h_by, LANES)
        is_first = (step == 0)[:, None]
        hr = tl.where(is_first, h0r[None, :], hr)
        hi = tl.where(is_first, h0i[None, :], hi)
        begins = _flags(start, row, step, exists, start_by, LANES) != 0
        grad_real = tl.where(begins, 0.0, gr * hr + gi * hi)
        grad_imaginary = tl.where(begins, 0.0, gi * hr - gr * hi)
        _store_pairs(grad_a, grad_real, grad_imaginary, row, step, exists, F, out_by, LANES)
