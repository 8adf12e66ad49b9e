"""S5: a diagonal complex state-space model in continuous time, discretised by zero-order hold."""

import functools
import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_numbers, check_sizes
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["S5", "hippo_frequencies"]


class S5(Memory):
    """h_t = exp(Lambda Delta) h_{t-1} + Lambda^{-1} (exp(Lambda Delta) - 1) B x_t and y_t = 2 Re(C
    h_t) + D x_t.

    Lambda = -exp(a) + i w is diagonal, so that nothing can explode; it begins with the eigenvalues
    of the normal part of HiPPO-LegS, one of every conjugate pair (hence the 2). Every pair has a
    step Delta of its own, learned, at first between ``dt_min`` and ``dt_max``. B and C begin with
    what the eigenvectors, a unitary matrix, make of real Gaussian matrices.

    The state ``"h"`` is complex and kept as its real and its imaginary part, [2, N]. The paper's
    layer has an activation behind y; here the network has one.

    Args:
        input_size: D.
        hidden_size: H, outputs. When it differs from ``input_size``, the vector D becomes a matrix.
        state_size: numbers in the state, 2 N, even; None is H, rounded up.
        dt_min: smallest initial step, positive.
        dt_max: largest initial step.

    Raises:
        ValueError: a size or step out of range.

    Source: Smith et al. (2023), arXiv 2208.04933, sections 2 and 3; starts inside a scan as in
        arXiv 2303.03982.
    """

    scan = staticmethod(linear_scan)

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        state_size: int | None = None,
        dt_min: float = 0.001,
        dt_max: float = 0.1,
    ) -> None:
        super().__init__(input_size, hidden_size)
        size = hidden_size + hidden_size % 2 if state_size is None else state_size
        check_sizes(state_size=size)
        check_numbers(dt_min=dt_min, dt_max=dt_max)
        if size < 2 or size % 2:
            raise ValueError(f"state_size must be even (conjugate pairs) and positive, got {size}")
        if not 0 < dt_min <= dt_max:
            raise ValueError(f"need 0 < dt_min <= dt_max, got dt_min={dt_min}, dt_max={dt_max}")
        pairs = size // 2
        self.state_shape = (2, pairs)
        self.log_decay = nn.Parameter(torch.full((pairs,), math.log(0.5)))
        self.frequency = nn.Parameter(torch.tensor(hippo_frequencies(pairs)))
        log_ratio = math.log(dt_max / dt_min)
        self.log_step = nn.Parameter(math.log(dt_min) + log_ratio * torch.rand(pairs))
        # real and imaginary part; both matrices have entries of variance one over their inputs
        self.input = nn.Parameter(torch.randn(2, pairs, input_size) / math.sqrt(2 * input_size))
        self.output = nn.Parameter(torch.randn(hidden_size, 2, pairs) / math.sqrt(2 * size))
        if input_size == hidden_size:
            skip = torch.randn(hidden_size)
        else:
            skip = torch.randn(hidden_size, input_size) / math.sqrt(input_size)
        self.skip = nn.Parameter(skip)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., 2, N]."""
        exact = torch.promote_types(x.dtype, torch.float32)  # complex numbers are no smaller
        rate = torch.complex(-torch.exp(self.log_decay.to(exact)), self.frequency.to(exact))
        exponent = rate * torch.exp(self.log_step.to(exact))
        gain = torch.expm1(exponent) / rate
        real, imag = self.input.to(exact)
        to_state = torch.complex(real, imag) * gain.unsqueeze(-1)
        b = F.linear(x.to(exact), torch.cat([to_state.real, to_state.imag]))
        before = h0.to(exact)
        h = self.scan(
            torch.exp(exponent),
            torch.complex(*b.chunk(2, dim=-1)),
            is_init,
            torch.complex(before[..., 0, :], before[..., 1, :]),
        )
        states = torch.stack([h.real, h.imag], dim=-2).to(x.dtype)
        real, imag = self.output.unbind(1)
        y = F.linear(states.flatten(-2), 2 * torch.cat([real, -imag], dim=-1))
        passed = x * self.skip if self.skip.ndim == 1 else F.linear(x, self.skip)
        return y + passed, states


@functools.cache
def hippo_frequencies(pairs: int) -> list[float]:
    """Positive imaginary parts of the eigenvalues of the normal part of HiPPO-LegS of side 2
    ``pairs``, in rising order; the real parts are all -1/2.

    Source: Gu et al. (2022), arXiv 2111.00396, theorem 1.
    """
    root = (torch.arange(2 * pairs, dtype=torch.float64, device="cpu") * 2 + 1).sqrt()
    lower = torch.outer(root, root).tril(-1) / 2
    values = torch.linalg.eigvalsh(1j * (lower.mT - lower))
    frequencies: list[float] = values[pairs:].tolist()
    return frequencies
