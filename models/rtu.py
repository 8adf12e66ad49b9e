"""Recurrent trace units: a diagonal rotation in real numbers, and a nonlinearity after it."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.lru import ring
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["RTU"]


class RTU(Memory):
    """a_t = g a_{t-1} - p b_{t-1} + c W_a x_t, b_t = g b_{t-1} + p a_{t-1} + c W_b x_t, and y_t = U
    relu([a_t, b_t]) + d, with g = r cos(theta), p = r sin(theta), c = sqrt(1 - r^2).

    r = exp(-exp(nu)) and theta = exp(theta_log) are learned, one of each a channel. This is the
    *linear* unit of the paper, whose nonlinearity stands outside of the recurrence, hence a scan:
    a + i b is a complex channel as in the LRU. Differs from the LRU by the nonlinearity and by c,
    which follows r instead of being learned. U is ours: it brings the paper's output, relu([a, b]),
    to the width H. The paper trains it by real-time recurrent learning; here it is trained by
    backpropagation through the scan, which is the same gradient over a window.

    The state ``"h"`` is a and b as pairs [H, 2].

    Args:
        input_size: D.
        hidden_size: H, channels and outputs.
        r_min: smallest initial r, in [0, r_max).
        r_max: largest initial r, in (r_min, 1].
        max_phase: initial theta are uniform in [0, max_phase] radians.

    Raises:
        ValueError: sizes, radii or phase out of range.

    Source: Elelimy et al. (2024), arXiv 2409.01449, section 3.
    """

    scan = staticmethod(linear_scan)

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        r_min: float = 0.0,
        r_max: float = 1.0,
        max_phase: float = 2 * math.pi,
    ) -> None:
        super().__init__(input_size, hidden_size)
        self.state_shape = (hidden_size, 2)
        square, phase = ring(hidden_size, r_min, r_max, max_phase)
        self.nu = nn.Parameter(torch.log(-0.5 * torch.log(square)))
        self.theta = nn.Parameter(torch.log(phase))
        self.input = nn.Parameter(
            torch.randn(hidden_size, 2, input_size) / math.sqrt(2 * input_size)
        )
        self.output = nn.Linear(2 * hidden_size, hidden_size)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., H, 2]."""
        exact = torch.promote_types(x.dtype, torch.float32)  # complex numbers are no smaller
        rate = torch.exp(self.nu.to(exact))
        factor = torch.polar(torch.exp(-rate), torch.exp(self.theta.to(exact)))
        scale = torch.sqrt(-torch.expm1(-2 * rate))  # sqrt(1 - r^2), also where r rounds to 1
        written = F.linear(x, self.input.flatten(0, 1)).unflatten(-1, (self.hidden_size, 2))
        written = torch.view_as_complex(written.to(exact) * scale[:, None])
        start = torch.complex(h0[..., 0].to(exact), h0[..., 1].to(exact))
        h = torch.view_as_real(self.scan(factor, written, is_init, start)).to(x.dtype)
        return self.output(F.relu(h.flatten(-2))), h
