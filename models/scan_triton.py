"""The linear scan by Triton: what CUDA runs. Triton is imported when a scan first runs on a card,
and only then.

A program (``_triton_kernels``) owns one batch row and `LANE_BYTES` of neighbouring features, takes
`CHUNK` steps at a time, scans them in parallel, and carries the state to the next chunk in
registers. So the forward pass reads a and b and writes h, each once: three tensors of [B, T, ...].
The backward pass reads a, h and the gradient that arrives and writes those of a and b, each once:
five. Factors that are expanded (the constant ones of an LRU) are read where they stand and never
spread out. For comparison: the doubling form moves about nine tensors in each of its log2(T)
passes.

Sizes. A row of a chunk is one cache line of 128 bytes: 32 float32, 16 complex64 or float64, 8
complex128, so that every line that is fetched is used whole. 64 steps make 8 KiB of each tensor on
their way at a time for a program; with the 256 programs of B = 16 and H = 512 that is 4 MiB of
inputs, more than what a fast card needs in flight to be busy (3 TB/s at a delay of 1 us: 3 MB),
where one step at a time would have 64 KiB. With 4 warps a thread holds 16 entries of a real chunk
and moves 16 bytes at a time; compiled for sm_80, sm_90 and sm_100, no kernel spills registers (at
most 128 a thread). How fast it is on a card has not been
measured; ``arcade-torch bench memory --device cuda`` does it where there is one.

Like every parallel form it multiplies factors of several steps. Where |a| is far above 1 such a
product can overflow though no state does; memories have |a| <= 1.

The matrix-valued recurrences need no kernel: the chunked form of ``scan_matrix`` consists of
batched matrix products and one triangular solve, which CUDA runs through cuBLAS, and no state per
step ever reaches memory.
"""

from functools import cache
from typing import Any

import torch
from torch import Tensor

__all__ = ["runs_triton", "scan_backward_triton", "scan_triton"]

CHUNK = 64
"""Steps that are scanned together."""
LANE_BYTES = 128
"""Bytes of neighbouring features in one program: a cache line."""
WARPS = 4
DTYPES = (torch.float32, torch.float64, torch.complex64, torch.complex128)


@cache
def _kernels() -> Any:
    """The module of the kernels, or None where Triton is not installed."""
    try:
        from arcade_torch.models import _triton_kernels
    except ImportError:
        return None
    return _triton_kernels


def runs_triton(x: Tensor) -> bool:
    """Whether there are kernels for the dtype, and Triton is installed.

    Args:
        x: any tensor.
    """
    return x.dtype in DTYPES and _kernels() is not None


def scan_triton(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor) -> Tensor:
    """``scan.scan`` in one kernel.

    Args:
        a: float32, float64, complex64 or complex128 [B, T, ...], any strides.
        b: like a.
        start: bool [B, T] or None. A factor there is not looked at, nor is anything before.
        h0: [B, ...].

    Returns:
        [B, T, ...], contiguous.

    Raises:
        RuntimeError: Triton is not installed, or has no kernel for the dtype.
    """
    h = torch.empty_like(b, memory_format=torch.contiguous_format)
    _launch("forward", (a, b), start, h0, (), (h,))
    return h


def scan_backward_triton(
    a: Tensor, start: Tensor | None, h0: Tensor, h: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor]:
    """``scan.scan_backward`` in one kernel.

    Args:
        a: float32, float64, complex64 or complex128 [B, T, ...], any strides.
        start: bool [B, T] or None.
        h0: [B, ...].
        h: [B, T, ...], like a.
        grad: like a.

    Returns:
        (grad_a, grad_b), both [B, T, ...] and contiguous.

    Raises:
        RuntimeError: Triton is not installed, or has no kernel for the dtype.
    """
    grad_a = torch.empty_like(grad, memory_format=torch.contiguous_format)
    grad_b = torch.empty_like(grad_a)
    _launch("backward", (a,), start, h0, (h, grad), (grad_a, grad_b))
    return grad_a, grad_b


def _launch(
    direction: str,
    first: tuple[Tensor, ...],
    start: Tensor | None,
    h0: Tensor,
    then: tuple[Tensor, ...],
    outputs: tuple[Tensor, ...],
) -> None:
    """Run one kernel over its tensors, in the order of its arguments."""
    output = outputs[0]
    if not runs_triton(output):
        raise RuntimeError(
            f"no Triton kernel for {output.dtype}: install triton, and use one of {DTYPES}"
        )
    if output.numel() == 0:
        return
    (batch, steps) = output.shape[:2]
    features = output[0, 0].numel()
    if start is None:
        start = torch.zeros((), dtype=torch.bool, device=output.device).expand(batch, steps)
    flat = [
        x.resolve_conj().resolve_neg().reshape(batch, steps, features)
        for x in (*first, *then, *outputs)
    ]
    flat[len(first) : len(first)] = [
        start.view(torch.uint8),
        h0.resolve_conj().resolve_neg().reshape(batch, features),
    ]
    # of the outputs once: all are contiguous
    strides = [x.stride() for x in flat[: len(flat) - len(outputs) + 1]]
    lanes = min(LANE_BYTES // output.element_size(), _power_of_two(features))
    kernel = getattr(_kernels(), f"{direction}_{'complex' if output.is_complex() else 'real'}")
    with torch.cuda.device_of(output):
        kernel[(batch * -(-features // lanes),)](
            *(torch.view_as_real(x) if x.is_complex() else x for x in flat),
            steps,
            features,
            *strides,
            CHUNK=min(CHUNK, max(8, _power_of_two(steps))),
            LANES=lanes,
            num_warps=WARPS,
        )


def _power_of_two(x: int) -> int:
    """The smallest power of two that is not below x."""
    return 1 << (x - 1).bit_length()
