"""Bistable memory recurrent unit: a latch with hysteresis in every channel, hence a linear scan."""

import math

import torch
from torch import Tensor, nn

from arcade_torch.models.arguments import is_number
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["BMRU", "surrogate_step"]


def surrogate_step(u: Tensor, slope: float) -> Tensor:
    """1 where u > 0 and else 0, with the derivative of a soft step: that of
    atan(pi/2 slope u) / pi, which is slope / 2 / (1 + (pi/2 slope u)^2).

    Args:
        u: float, any shape.
        slope: how steep the soft step is, above 0; its derivative is slope / 2 at u = 0.

    Returns:
        like u, 0 or 1 exactly; NaN where u is NaN.

    Source: the form of Fang et al. (2021), arXiv 2007.05785, for spiking neurons.

    Example:
        >>> u = torch.tensor([-0.5, 0.0, 2.0], requires_grad=True)
        >>> surrogate_step(u, 8.0).tolist()
        [0.0, 0.0, 1.0]
    """
    soft = torch.atan(0.5 * math.pi * slope * u) / math.pi
    return (u > 0).to(u.dtype) + (soft - soft.detach())


class BMRU(Memory):
    """c = W x + b, beta = \\|V x + d\\|, z = 1 where \\|c\\| > beta and else 0, h' = (1 - z) h + z
    sign(c), y = h'.

    A latch (Schmitt trigger) a channel: an input beyond the threshold beta sets h to 1 or -1,
    every other input leaves it as it is, to the bit and for any number of steps. The decay 1 - z is
    0 or 1 and looks at the input alone, hence a scan. At the start of an episode h is 0, which is
    neither of the two stable states: the latch has not been set.

    Steps have no useful derivative. In the backward pass z and sign(c) = 2 [c > 0] - 1 have that
    of :func:`surrogate_step`; that of h by the state before is exact. An input so near to the
    threshold that rounding decides may set the latch in one computation and not in another, as on
    another device.

    Written from the equations above and the abstracts of the two papers below, which name the means
    (two stable states with hysteresis, no transients, a parallel scan); the papers' text and code
    were not at hand. The surrogate, its slope, the initial weights (torch's default of a linear
    layer), states of size 1, and y = h are ours. So it may differ from the authors' code. A size
    that is learned for each channel was no better in tests of memory: a linear layer behind h
    scales it.

    Args:
        input_size: D.
        hidden_size: H, latches and outputs.
        slope: of the surrogate, above 0.

    Raises:
        ValueError: sizes or slope out of range.

    Source: De Geeter, Lambrechts, Ernst and Drion (2026), arXiv 2601.09495; on its gradients
        Brandoit, Fyon, Ernst and Drion (2026), arXiv 2605.11855.
    """

    scan = staticmethod(linear_scan)
    surrogate_gradients = True

    def __init__(self, input_size: int, hidden_size: int, *, slope: float = 8.0) -> None:
        super().__init__(input_size, hidden_size)
        if not is_number(slope) or slope <= 0:
            raise ValueError(f"slope must be a number above 0, got {slope!r}")
        self.slope = slope
        self.state_shape = (hidden_size,)
        self.candidate_and_threshold = nn.Linear(input_size, 2 * hidden_size)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`."""
        candidate, threshold = self.candidate_and_threshold(x).chunk(2, dim=-1)
        sets = surrogate_step(candidate.abs() - threshold.abs(), self.slope)
        sign = 2 * surrogate_step(candidate, self.slope) - 1
        h = self.scan(1 - sets, sets * sign, is_init, h0)
        return h, h
