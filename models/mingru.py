"""MinGRU: a gated recurrence whose gate looks only at the input, hence a linear scan."""

from typing import Literal

import torch
from torch import Tensor, nn

from arcade_torch.models.arguments import check_flags
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["MinGRU"]

SLOW_GATE_BIAS = (-5.0, 0.0)  # sigmoid of it: a channel forgets over 2 to 150 steps


class MinGRU(Memory):
    """g = sigmoid(W1 x + b1), h' = (1 - g) h + g c, y = h', with the candidate c = tanh(W2 x + b2).

    Differs from the reference package, which omits the tanh and combines (state, gate) pairs with
    an operator that is not associative; here acting and learning compute the same function.

    Args:
        input_size: D.
        hidden_size: H.
        candidate: "tanh" (the paper's equation) or "linear" (c = W2 x + b2, as in the original
            MinGRU).
        slow_gates: draw the gate's bias from U(-5, 0), which spreads the channels' time scales,
            instead of torch's default (all channels forget half at every step).

    Raises:
        ValueError: unknown candidate, or sizes not positive.

    Source: POPGym Arcade, appendix on memory models; Feng et al. (2024), arXiv 2410.01201.
    """

    scan = staticmethod(linear_scan)

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        candidate: Literal["tanh", "linear"] = "tanh",
        slow_gates: bool = False,
    ) -> None:
        super().__init__(input_size, hidden_size)
        check_flags(slow_gates=slow_gates)
        if candidate not in ("tanh", "linear"):
            raise ValueError(f"candidate must be 'tanh' or 'linear', got {candidate!r}")
        self.candidate = candidate
        self.state_shape = (hidden_size,)
        self.gate_and_candidate = nn.Linear(input_size, 2 * hidden_size)
        if slow_gates:
            nn.init.uniform_(self.gate_and_candidate.bias[:hidden_size], *SLOW_GATE_BIAS)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`."""
        gate, candidate = self.gate_and_candidate(x).chunk(2, dim=-1)
        gate = torch.sigmoid(gate)
        if self.candidate == "tanh":
            candidate = torch.tanh(candidate)
        h = self.scan(1 - gate, gate * candidate, is_init, h0)
        return h, h
