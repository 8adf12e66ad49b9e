"""What the tests of the Triton back end run, in the interpreter and on a card: the scan beside its
loop in float64.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from arcade_torch.models.scan import linear_scan

TOLERANCE = {
    torch.float32: 1e-5,
    torch.complex64: 1e-5,
    torch.float64: 1e-12,
    torch.complex128: 1e-12,
}
LENGTHS = [1, 2, 3, 7, 31, 32, 33, 128, 132, 300]


def linear_scan_loop(
    a: Tensor, b: Tensor, start: Tensor | None = None, h0: Tensor | None = None
) -> Tensor:
    """The same function as ``linear_scan``, step by step: the oracle."""
    a = a.expand(b.shape)
    begins = torch.zeros(b.shape[:2], dtype=torch.bool) if start is None else start.clone()
    stored = torch.zeros_like(b)
    h = torch.zeros_like(b[:, 0])
    if h0 is not None and h0.ndim == b.ndim:
        stored = h0
        begins[:, 0] = True
    elif h0 is not None:
        h = h0
    states = []
    for t in range(b.shape[1]):
        h = torch.where(begins[:, t].reshape(-1, *[1] * (h.ndim - 1)), stored[:, t], h)
        h = a[:, t] * h + b[:, t]
        states.append(h)
    return torch.stack(states, dim=1)


def problem(
    batch: int = 2,
    steps: int = 7,
    features: tuple[int, ...] = (3,),
    dtype: torch.dtype = torch.float64,
    resets: float = 0.1,
    device: str = "cpu",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random (a, b, start, h0), |a| between 0 and 1.1, drawn on the CPU."""
    a, b, h0 = (
        torch.randn(batch, *rest, *features, dtype=dtype) for rest in ((steps,), (steps,), ())
    )
    a = a / a.abs().clamp_min(1e-6) * torch.rand(a.shape) * 1.1
    start = torch.rand(batch, steps) < resets
    return a.to(dtype).to(device), b.to(device), start.to(device), h0.to(device)


def assert_close(ours: Sequence[Tensor], exact: Sequence[Tensor], tolerance: float) -> None:
    """Compare values with what was computed in float64, relative to the largest entry where that is
    above 1.
    """
    for x, y in zip(ours, exact, strict=True):
        scale = max(1.0, float(y.abs().max())) if y.numel() else 1.0
        torch.testing.assert_close(x.to(y.dtype).cpu() / scale, y / scale, rtol=0, atol=tolerance)


def assert_equals_the_loop(a: Tensor, b: Tensor, start: Tensor | None, h0: Tensor | None) -> None:
    """Values, and gradients of everything, of ``linear_scan`` and of the loop run in float64 on the
    CPU.
    """
    inputs = [x.detach().requires_grad_() for x in (a, b, h0) if x is not None]
    h = linear_scan(*inputs[:2], start, *inputs[2:])
    weight = torch.randn(h.shape, dtype=h.dtype).to(h.device)
    ours = [h, *torch.autograd.grad(h, inputs, weight)]
    wide = torch.complex128 if h.is_complex() else torch.float64
    exact = [x.detach().to(wide).cpu().requires_grad_() for x in inputs]
    flags = None if start is None else start.cpu()
    loop = linear_scan_loop(*exact[:2], flags, *exact[2:])
    assert_close(
        ours,
        [loop.detach(), *torch.autograd.grad(loop, exact, weight.to(wide).cpu())],
        TOLERANCE[h.dtype],
    )


def assert_nothing_crosses_a_start(where: int, dtype: torch.dtype, device: str = "cpu") -> None:
    """Gradients before a start are exactly zero, and nothing that is put there changes a bit of
    what comes after.
    """
    a, b, start, h0 = problem(2, 20, (3,), dtype, resets=0.0, device=device)
    start[:, where] = True
    inputs = [x.requires_grad_() for x in (a, b, h0)]
    h = linear_scan(a, b, start, h0)
    grads = torch.autograd.grad(h[:, where:].abs().square().sum(), inputs)
    assert (
        (grads[0][:, : where + 1] == 0).all()
        and (grads[1][:, :where] == 0).all()
        and (grads[2] == 0).all()
    )
    for poison in (1e30, torch.inf, torch.nan):
        spoilt = [x.detach().clone() for x in inputs]
        spoilt[0][:, :where], spoilt[1][:, :where], spoilt[2][:] = poison, poison, poison
        leaves = [x.requires_grad_() for x in spoilt]
        again = linear_scan(leaves[0], leaves[1], start, leaves[2])
        assert torch.equal(again[:, where:], h[:, where:])
        of_a, of_b = torch.autograd.grad(again[:, where:].abs().square().sum(), leaves[:2])
        assert torch.equal(of_a[:, where:], grads[0][:, where:]) and torch.equal(
            of_b[:, where:], grads[1][:, where:]
        )
