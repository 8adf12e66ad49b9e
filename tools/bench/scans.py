"""The linear scan on a CPU: the operator of this package beside the other ways to write it, in one run.

Every form solves h_t = a_t h_{t-1} + b_t from zeros, real or complex, with starts folded in as a_t = 0, so that all of
them do the same. The operator has a backward pass of its own; the others are differentiated by autograd.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from arcade_torch.models.scan import linear_scan, scan_doubling
from arcade_torch.tools.bench.harness import Measure, interleaved

RESETS = 0.02
"""Share of the steps that open an episode."""

Run = Callable[..., Tensor]
Key = TypeVar("Key")


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


FORMS: dict[str, Run] = {
    "serial operator (in use)": linear_scan,
    "loop over unbind": unbind_loop,
    "doubling": doubling,
    "torch's associative_scan, generic": generic_associative_scan,
}


def both_passes(run: Run, backward: Callable[[Tensor], None], inputs: tuple[Tensor, ...]) -> Callable[[], Tensor]:
    """What does the forward and the backward pass; inputs that are not bool get gradients."""
    leaves = [x.clone().requires_grad_(x.dtype != torch.bool) for x in inputs]

    def work() -> Tensor:
        for leaf in leaves:
            leaf.grad = None
        out = run(*leaves)
        backward(out)
        return out

    return work


def time_passes(
    runs: Mapping[Key, Run],
    backward: Callable[[Tensor], None],
    inputs: tuple[Tensor, ...],
    seconds: float,
    repeats: int,
) -> dict[Key, dict[str, float]]:
    """Best milliseconds of the forward pass alone and of both passes, measured in turns."""
    forward = {f"{key} forward": Measure(torch.no_grad()(partial(run, *inputs))) for key, run in runs.items()}
    both = {f"{key} both": Measure(both_passes(run, backward, inputs)) for key, run in runs.items()}
    found = interleaved(forward | both, seconds, repeats, warm_ups=1)
    return {key: {f"{part}_ms": found[f"{key} {part}"].best_ms for part in ("forward", "both")} for key in runs}


def random_scan(batch: int, steps: int, size: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Random a with absolute values below 1, random b, and starts."""
    a, b = (torch.randn(batch, steps, size, dtype=dtype) for _ in "ab")
    return a / a.abs().clamp_min(1e-3) * torch.rand(batch, steps, size), b, torch.rand(batch, steps) < RESETS


def bench_scans(batch: int, steps: int, size: int, seconds: float, repeats: int) -> Iterator[dict[str, Any]]:
    """Every form in turns, one row each."""
    for numbers, dtype, exact in (
        ("real", torch.float32, torch.float64),
        ("complex", torch.complex64, torch.complex128),
    ):
        a, b, start = random_scan(batch, steps, size, dtype)
        a[start] = 0
        weight, right = torch.randn_like(b), linear_scan(a.to(exact), b.to(exact))
        times = time_passes(FORMS, partial(Tensor.backward, gradient=weight), (a, b), seconds, repeats)
        for name, form in FORMS.items():
            error = float((form(a, b) - right).abs().max())
            yield {"form": name, "steps": steps, "numbers": numbers, **times[name], "error": error}
