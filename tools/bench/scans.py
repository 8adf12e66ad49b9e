"""The linear scan on a CPU: the operator of this package beside the other ways to write it, in one run.

Every form solves h_t = a_t h_{t-1} + b_t from zeros, real or complex, with starts folded in as a_t = 0, so that all of
them do the same. The operator has a backward pass of its own; the others are differentiated by autograd.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from arcade_torch.models.scan import linear_scan, scan_doubling
from arcade_torch.tools.bench.harness import Measure, interleaved, no_check, torch_threads

Scan = Callable[[Tensor, Tensor], Tensor]
CHOSEN = "serial operator (in use)"


def unbind_loop(a: Tensor, b: Tensor, start: Tensor | None = None, h0: Tensor | None = None) -> Tensor:
    """The loop that is fastest under autograd; the function of ``linear_scan`` for one state ``h0`` or none.

    Indexing ``b[:, t]`` instead makes the backward pass quadratic in T.
    """
    h = b.new_zeros(b[:, 0].shape) if h0 is None else h0
    begins = [None] * b.shape[1] if start is None else start.reshape(*start.shape, *[1] * (b.ndim - 2)).unbind(1)
    states = []
    for a_t, b_t, begins_t in zip(a.expand(b.shape).unbind(1), b.unbind(1), begins, strict=True):
        h = torch.addcmul(b_t, a_t, h if begins_t is None else h.masked_fill(begins_t, 0))
        states.append(h)
    return torch.stack(states, dim=1)


def doubling(a: Tensor, b: Tensor) -> Tensor:
    """log2(T) passes over the whole tensor (Hillis and Steele 1986): the back end of CUDA without Triton."""
    h: Tensor = scan_doubling(a, b, None, torch.zeros_like(b[:, 0]))
    return h


def generic_associative_scan(a: Tensor, b: Tensor) -> Tensor:
    """Torch's own, not yet public; its fast mode refuses tensors on a CPU."""
    from torch._higher_order_ops.associative_scan import associative_scan

    def combine(left: tuple[Tensor, Tensor], right: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        return right[0] * left[0], right[0] * left[1] + right[1]

    h: Tensor = associative_scan(combine, (a, b), dim=1, combine_mode="generic")[1]
    return h


FORMS: dict[str, Scan] = {
    CHOSEN: linear_scan,
    "loop over unbind": unbind_loop,
    "doubling": doubling,
    "torch's associative_scan, generic": generic_associative_scan,
}


@dataclass(frozen=True)
class ScanRow:
    """One form at one length."""

    form: str
    steps: int
    numbers: str
    forward_ms: float
    both_ms: float
    error: float


def bench_scans(
    steps: Sequence[int],
    batch: int = 16,
    size: int = 512,
    *,
    threads: int = 1,
    seconds: float = 0.3,
    repeats: int = 3,
    tell: Callable[[str], None] = lambda text: None,
) -> Iterator[ScanRow]:
    """Time every form in turns."""
    with torch_threads(threads):
        for length in steps:
            for dtype in (torch.float32, torch.complex64):
                numbers = "complex" if dtype.is_complex else "real"
                tell(f"scans, T = {length}, {numbers}")
                yield from _forms(length, batch, size, dtype, numbers, seconds, repeats)


def _forms(
    length: int, batch: int, size: int, dtype: torch.dtype, numbers: str, seconds: float, repeats: int
) -> list[ScanRow]:
    a, b = (torch.randn(batch, length, size, dtype=dtype) for _ in "ab")
    a = a / a.abs().clamp_min(1e-3) * torch.rand(batch, length, size)
    a[torch.rand(batch, length) < 0.02] = 0
    double = torch.complex128 if dtype.is_complex else torch.float64
    exact = linear_scan(a.to(double), b.to(double))
    weight = torch.randn_like(b)
    measures, errors = {}, {}
    for name, form in FORMS.items():
        errors[name] = float((form(a, b) - exact).abs().max())
        measures[f"{name}, forward"] = Measure(_forward(form, a, b), no_check, 1)
        measures[f"{name}, both"] = Measure(_both(form, a, b, weight), no_check, 1)
    found = interleaved(measures, seconds, repeats, warm_ups=1)
    best = {key: 1e3 / max(measured.rates) for key, measured in found.items()}
    return [
        ScanRow(name, length, numbers, best[f"{name}, forward"], best[f"{name}, both"], error)
        for name, error in errors.items()
    ]


def _forward(form: Scan, a: Tensor, b: Tensor) -> Callable[[], object]:
    @torch.no_grad()
    def work() -> object:
        return form(a, b)

    return work


def _both(form: Scan, a: Tensor, b: Tensor, weight: Tensor) -> Callable[[], object]:
    leaves = [x.clone().requires_grad_() for x in (a, b)]
    return lambda: torch.autograd.grad(form(*leaves), leaves, weight)
