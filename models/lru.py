"""Linear recurrent unit: a diagonal complex linear recurrence."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_numbers
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["LRU", "ring"]


def ring(size: int, r_min: float, r_max: float, max_phase: float) -> tuple[Tensor, Tensor]:
    """Draw numbers uniformly from a ring of the complex plane.

    Args:
        size: how many.
        r_min: inner radius, in [0, r_max).
        r_max: outer radius, in (r_min, 1].
        max_phase: phases are uniform in [0, max_phase] radians; at least 0.

    Returns:
        (squares of their radii, phases), float [size]; kept away from 0 and 1, for logarithms.

    Raises:
        ValueError: radii or phase out of range.

    Source: Orvieto et al. (2023), arXiv 2303.06349, lemma 3.2.
    """
    check_numbers(r_min=r_min, r_max=r_max, max_phase=max_phase)
    if not 0 <= r_min < r_max <= 1:
        raise ValueError(f"need 0 <= r_min < r_max <= 1, got r_min={r_min}, r_max={r_max}")
    if max_phase < 0:
        raise ValueError(f"max_phase must be a number of radians from 0, got {max_phase}")
    square = (torch.rand(size) * (r_max**2 - r_min**2) + r_min**2).clamp(1e-8, 1 - 1e-6)
    phase = (max_phase * torch.rand(size)).clamp_min(1e-8)
    return square, phase


class LRU(Memory):
    """h_t = lambda h_{t-1} + exp(gamma) B x_t and y_t = Re(C h_t) + D x_t, lambda = exp(-exp(nu) +
    i exp(theta)).

    The state ``"h"`` is complex and kept as real pairs [B, H, 2], so that primers, checkpoints and
    storages see floats. B is stored as its real and imaginary parts and C as (Re C, -Im C), so both
    products are one real matrix product.

    Args:
        input_size: D.
        hidden_size: H, complex channels and outputs. When it differs from ``input_size``, the
            vector D becomes a matrix [H, D].
        r_min: smallest initial \\|lambda\\|, in [0, r_max).
        r_max: largest initial \\|lambda\\|, in (r_min, 1].
        max_phase: initial phases are uniform in [0, max_phase] radians.

    Raises:
        ValueError: sizes, radii or phase out of range.

    Source: Orvieto et al. (2023), arXiv 2303.06349, eq. 8 and lemma 3.2.
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
        self.gamma = nn.Parameter(0.5 * torch.log1p(-square))
        self.input = nn.Parameter(
            torch.randn(hidden_size, 2, input_size) / math.sqrt(2 * input_size)
        )
        self.output = nn.Parameter(
            torch.randn(hidden_size, hidden_size, 2) / math.sqrt(hidden_size)
        )
        if input_size == hidden_size:
            skip = torch.randn(hidden_size)
        else:
            skip = torch.randn(hidden_size, input_size) / math.sqrt(input_size)
        self.skip = nn.Parameter(skip)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., H, 2]."""
        exact = torch.promote_types(x.dtype, torch.float32)  # complex numbers are no smaller
        size = torch.exp(-torch.exp(self.nu.to(exact)))
        decay = torch.polar(size, torch.exp(self.theta.to(exact)))
        scaled = (self.input * torch.exp(self.gamma)[:, None, None]).flatten(0, 1)
        b = F.linear(x, scaled).unflatten(-1, (self.hidden_size, 2)).to(exact)
        start = torch.complex(h0[..., 0].to(exact), h0[..., 1].to(exact))
        h = torch.view_as_real(self.scan(decay, torch.view_as_complex(b), is_init, start))
        h = h.to(x.dtype)
        passed = x * self.skip if self.skip.ndim == 1 else F.linear(x, self.skip)
        return F.linear(h.flatten(-2), self.output.flatten(1)) + passed, h
