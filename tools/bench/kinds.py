"""Which kinds of operation a piece of work spends its time on."""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

KINDS = {
    "convolutions": ("convolution",),
    "pooling": ("max_pool",),
    "recurrence": ("linear_scan", "matrix_scan"),
    "matrix products": ("addmm", "::mm", "bmm", "matmul"),
    "activations": ("leaky_relu",),
    "copies and casts": ("copy", "aten::cat", "clone", "index_select", "aten::fill_", "aten::zero_"),
}
"""Kinds of operation, by parts of their names; the rest is elementwise, most of it the optimiser's, and Python."""
REST = "the rest"
PASSES = 5
"""Of each sort; medians count."""


def shares_of_kinds(work: Callable[[], object], device: torch.device) -> dict[str, float]:
    """Shares of the kinds of operation in the time of some work.

    On the CPU every operation is timed where torch dispatches it. Torch's profiler is not used there: its own memory
    comes between the tensors', which then land on new pages, and what page faults cost shows up as filling and
    copying (3 to 27 % of a gradient step of the paper's network, from pass to pass). On CUDA it is used, and kernels
    count.

    Args:
        work: is called to warm up, then `PASSES` times as it is and with a clock, in turns.
        device: where its time is spent.

    Returns:
        Kind -> share, those of `KINDS` and "the rest"; they add up to 1.
    """
    work()
    seconds = _on_device(work) if device.type == "cuda" else _where_dispatched(work)
    total = sum(seconds.values())
    return {kind: value / total for kind, value in seconds.items()}


def kind_of(name: str) -> str:
    """Kind of an operation by its name.

    Example:
        >>> kind_of("aten::convolution"), kind_of("aten::max_pool2d_with_indices_backward"), kind_of("aten::mul")
        ('convolutions', 'pooling', 'the rest')
    """
    return next((kind for kind, words in KINDS.items() if any(word in name for word in words)), REST)


def _where_dispatched(work: Callable[[], object]) -> dict[str, float]:
    whole, parts = [], []
    for _ in range(PASSES):
        began = time.perf_counter()
        work()
        whole.append(time.perf_counter() - began)
        with _Clock() as clock:
            work()
        parts.append(clock.seconds)
    seconds = {kind: median(part[kind] for part in parts) for kind in KINDS}
    # Timing slows Python down, not the operations: what it took without is the whole, and what is left the rest.
    return seconds | {REST: max(0.0, median(whole) - sum(seconds.values()))}


class _Clock(TorchDispatchMode):
    """Adds up the seconds of every operation, those that it calls included."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds = dict.fromkeys([*KINDS, REST], 0.0)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        began = time.perf_counter()
        found = func(*args, **(kwargs or {}))
        self.seconds[kind_of(func.name())] += time.perf_counter() - began
        return found


def _on_device(work: Callable[[], object]) -> dict[str, float]:
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        work()
    seconds = dict.fromkeys([*KINDS, REST], 0.0)
    for event in profiler.key_averages():
        seconds[kind_of(event.key)] += event.self_device_time_total
    return seconds
