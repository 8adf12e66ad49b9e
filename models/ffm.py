"""Fast and Forgetful Memory: sums that decay and turn, each input added at many rates at once."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["FFM"]

FORGOTTEN = 0.01  # what the slowest trace keeps of an input ...
PERIOD = 1024  # ... after so many steps; also the longest period of a context, in steps
FASTEST = 0.5  # largest initial decay a step


class FFM(Memory):
    """S_t = exp(-\\|alpha\\| + i omega) S_{t-1} + u_t, u_t = l1(x_t) sigmoid(l2(x_t)), and
    y_t = LN(l3(S_t)) sigmoid(l4(x_t)) + l5(x_t) (1 - sigmoid(l4(x_t))).

    S is complex [m, c]: trace j decays at alpha_j, context k turns at omega_k, and every context
    gets the same input. l1 to l5 are linear maps, l3 of the real and imaginary parts; LN is a
    layer norm without parameters. The state ``"h"`` is S as real pairs [m, c, 2].

    The published code multiplies by exp(alpha t) over a whole sequence and divides again, which
    needs double precision and bounds alpha by the length; here every step decays what is there, so
    nothing grows, and alpha is any number.

    Args:
        input_size: D.
        hidden_size: H.
        trace_size: m; None is H / 8, rounded, and at least 2: a state of about H numbers.
        context_size: c.

    Raises:
        ValueError: a size is not positive.

    Source: Morad et al. (2023), arXiv 2310.04128, section 4; initial omega as there, initial alpha
        from the one that leaves 1 % after 1,024 steps up to 0.5, evenly in its logarithm.
    """

    scan = staticmethod(linear_scan)

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        trace_size: int | None = None,
        context_size: int = 4,
    ) -> None:
        super().__init__(input_size, hidden_size)
        traces = max(2, round(hidden_size / 8)) if trace_size is None else trace_size
        check_sizes(trace_size=traces, context_size=context_size)
        if traces < 1 or context_size < 1:
            raise ValueError(
                f"trace_size and context_size must be positive, got {trace_size} and {context_size}"
            )
        self.trace_size = traces
        self.context_size = context_size
        self.state_shape = (traces, context_size, 2)
        slowest = math.log(1 / FORGOTTEN) / PERIOD
        decays = torch.linspace(math.log(slowest), math.log(FASTEST), traces)
        self.alpha = nn.Parameter(torch.exp(decays))
        self.omega = nn.Parameter(2 * math.pi / torch.linspace(1, PERIOD, context_size))
        self.write = nn.Linear(input_size, 2 * traces)
        self.mix = nn.Linear(2 * traces * context_size, hidden_size)
        self.gate_and_skip = nn.Linear(input_size, 2 * hidden_size)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., m, c, 2]."""
        exact = torch.promote_types(x.dtype, torch.float32)  # complex numbers are no smaller
        shape = (self.trace_size, self.context_size)
        size = torch.exp(-self.alpha.to(exact).abs())
        decay = torch.polar(size[:, None].expand(shape), self.omega.to(exact).expand(shape))
        value, gate = self.write(x).chunk(2, dim=-1)
        written = (value * torch.sigmoid(gate)).to(exact)[..., None].expand(*x.shape[:2], *shape)
        start = torch.complex(h0[..., 0].to(exact), h0[..., 1].to(exact))
        states = self.scan(decay, torch.complex(written, torch.zeros_like(written)), is_init, start)
        h = torch.view_as_real(states).to(x.dtype)
        read = F.layer_norm(self.mix(h.flatten(2)), (self.hidden_size,))
        gate, skip = self.gate_and_skip(x).chunk(2, dim=-1)
        return torch.lerp(skip, read, torch.sigmoid(gate)), h

    def extra_repr(self) -> str:
        """Sizes and options, for printing."""
        return (
            f"{super().extra_repr()}, trace_size={self.trace_size}, "
            f"context_size={self.context_size}"
        )
