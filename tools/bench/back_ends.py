"""The back ends of the linear scan on one device, as shares of what a plain copy of the same bytes takes there."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from arcade_torch.models.scan import BACK_ENDS, linear_scan_loop

RESETS = 0.02
"""Share of the steps that open an episode."""
FORWARD_TENSORS, BACKWARD_TENSORS = 3, 5
"""Tensors [B, T, H] that have to be read or written: a, b, h; and a, h, the gradients of h, a and b."""
FLUSHED = 256 * 2**20
"""Bytes that are written before every measure on a card: more than a cache holds, and time enough for the processor to
queue the work, so that neither a warm cache nor the launch is measured."""


@dataclass(frozen=True)
class BackEndRow:
    """One back end at one length."""

    back_end: str
    steps: int
    numbers: str
    forward_ms: float
    backward_ms: float
    forward_share: float
    backward_share: float
    error: float


def device_ms(work: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Milliseconds that the device takes, median; on a card its own clock, with cold caches."""
    work()
    if device.type != "cuda":
        times = []
        for _ in range(repeats):
            begin = time.perf_counter()
            work()
            times.append(1e3 * (time.perf_counter() - begin))
        return median(times)
    cold = torch.empty(FLUSHED, dtype=torch.uint8, device=device)
    events = [[torch.cuda.Event(enable_timing=True) for _ in "be"] for _ in range(repeats)]
    for begins, ends in events:
        cold.zero_()
        begins.record()
        work()
        ends.record()
    torch.cuda.synchronize(device)
    return float(median(begins.elapsed_time(ends) for begins, ends in events))


def bench_back_ends(
    device: torch.device,
    steps: Sequence[int],
    batch: int = 16,
    size: int = 512,
    *,
    names: Sequence[str] = ("triton", "doubling", "serial"),
    repeats: int = 20,
    tell: Callable[[str], None] = lambda text: None,
) -> Iterator[BackEndRow]:
    """Measure the operators themselves, without autograd, float32 and complex64."""
    for length in steps:
        for dtype in (torch.float32, torch.complex64):
            numbers = "complex" if dtype.is_complex else "real"
            tell(f"back ends on {device}, T = {length}, {numbers}")
            tensors = _tensors(length, batch, size, dtype, device)
            copies = [
                device_ms(_copy(count * tensors[0].numel() // 2, dtype, device), device, repeats)
                for count in (FORWARD_TENSORS, BACKWARD_TENSORS)
            ]
            for name in names:
                yield _measure(name, tensors, copies, numbers, repeats)


def _tensors(length: int, batch: int, size: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """a with |a| < 1, b, start, h0 and the gradient that arrives."""
    a, b, grad = (torch.randn(batch, length, size, dtype=dtype) for _ in "abg")
    a = a / a.abs().clamp_min(1e-3) * torch.rand(batch, length, size)
    start, h0 = torch.rand(batch, length) < RESETS, torch.randn(batch, size, dtype=dtype)
    return tuple(x.to(device) for x in (a, b, start, h0, grad))


def _copy(count: int, dtype: torch.dtype, device: torch.device) -> Callable[[], object]:
    source = torch.zeros(count, dtype=dtype, device=device)
    target = torch.empty_like(source)
    return lambda: target.copy_(source)


def _measure(name: str, tensors: tuple[Tensor, ...], copies: Sequence[float], numbers: str, repeats: int) -> BackEndRow:
    a, b, start, h0, grad = tensors
    forward, backward = BACK_ENDS[name]
    h = forward(a, b, start, h0)
    double = torch.complex128 if h.is_complex() else torch.float64
    exact = linear_scan_loop(a.cpu().to(double), b.cpu().to(double), start.cpu(), h0.cpu().to(double))
    forward_ms = device_ms(lambda: forward(a, b, start, h0), h.device, repeats)
    backward_ms = device_ms(lambda: backward(a, start, h0, h, grad), h.device, repeats)
    return BackEndRow(
        name,
        b.shape[1],
        numbers,
        forward_ms,
        backward_ms,
        copies[0] / forward_ms,
        copies[1] / backward_ms,
        float((h.cpu() - exact).abs().max()),
    )
