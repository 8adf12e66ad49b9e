"""Gated recurrent unit, the paper's variant (not torch's)."""

import torch
from torch import Tensor, nn

from arcade_torch.models.base import Memory

__all__ = ["GRU"]


class GRU(Memory):
    """z, r = sigmoid(W x + U h), c = tanh(W_h x + U_h (r h)), h' = (1 - z) h + z c, y = h'.

    Sequential in time. Not ``torch.nn.GRU``: the reset gate acts on h *before* U_h, z has the other sense, and U has no
    bias.

    Args:
        input_size: D.
        hidden_size: H.

    Raises:
        ValueError: sizes not positive.

    Source: POPGym Arcade, appendix on memory models; Cho et al. (2014), arXiv 1406.1078, eqs. 5 to 8 (with z and 1 - z
        exchanged).
    """

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size)
        self.state_shape = (hidden_size,)
        self.from_input = nn.Linear(input_size, 3 * hidden_size)
        self.gates_from_state = nn.Linear(hidden_size, 2 * hidden_size, bias=False)
        self.candidate_from_state = nn.Linear(hidden_size, hidden_size, bias=False)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`."""
        sizes = [2 * self.hidden_size, self.hidden_size]
        gates, candidates = (part.unbind(1) for part in self.from_input(x).split(sizes, dim=-1))
        to_gates, to_candidate = self.gates_from_state.weight.t(), self.candidate_from_state.weight.t()
        per_step = h0.ndim == x.ndim
        h = h0[:, 0] if per_step else h0
        fresh = h0.unbind(1) if per_step else [h0.new_zeros(())] * x.shape[1]
        begins = is_init.unsqueeze(-1).unbind(1)
        states = []
        for t in range(x.shape[1]):
            h = torch.where(begins[t], fresh[t], h)
            z, r = torch.sigmoid(torch.addmm(gates[t], h, to_gates)).chunk(2, dim=-1)
            c = torch.tanh(torch.addmm(candidates[t], r * h, to_candidate))
            h = torch.lerp(h, c, z)
            states.append(h)
        y = torch.stack(states, dim=1)
        return y, y
