"""The back ends of the linear scan on one device, as shares of what a plain copy of the same bytes takes there."""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import median
from typing import NamedTuple

import torch

from arcade_torch.models.scan import BACK_ENDS, linear_scan_loop
from arcade_torch.tools.bench.scans import random_scan

FORWARD_TENSORS, BACKWARD_TENSORS = 3, 5
"""Tensors [B, T, H] that have to be read or written: a, b, h; and a, h, the gradients of h, a and b."""
FLUSHED = 256 * 2**20
"""Bytes that are written before every measure on a card: more than a cache holds, and time enough for the processor to
queue the work, so that neither a warm cache nor the launch is measured."""


class BackEndRow(NamedTuple):
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
) -> Iterator[BackEndRow]:
    """Measure the operators themselves, without autograd, float32 and complex64."""
    for length in steps:
        for dtype, numbers in ((torch.float32, "real"), (torch.complex64, "complex")):
            a, b, start = (x.to(device) for x in random_scan(batch, length, size, dtype))
            h0, grad = torch.randn_like(b[:, 0]), torch.randn_like(b)
            double = torch.complex128 if dtype.is_complex else torch.float64
            exact = linear_scan_loop(a.cpu().to(double), b.cpu().to(double), start.cpu(), h0.cpu().to(double))
            copies = []
            for tensors in (FORWARD_TENSORS, BACKWARD_TENSORS):  # a copy reads and writes
                source = torch.zeros(tensors * b.numel() // 2, dtype=dtype, device=device)
                target = torch.empty_like(source)
                copies.append(device_ms(partial(target.copy_, source), device, repeats))
            for name in names:
                forward, backward = BACK_ENDS[name]
                h = forward(a, b, start, h0)
                calls = (partial(forward, a, b, start, h0), partial(backward, a, start, h0, h, grad))
                forward_ms, backward_ms = (device_ms(call, device, repeats) for call in calls)
                yield BackEndRow(
                    name,
                    length,
                    numbers,
                    forward_ms,
                    backward_ms,
                    forward_share=copies[0] / forward_ms,
                    backward_share=copies[1] / backward_ms,
                    error=float((h.cpu() - exact).abs().max()),
                )
