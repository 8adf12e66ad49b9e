"""GTrXL: a transformer layer whose skips are gates, over a sliding window."""

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_numbers
from arcade_torch.models.attention import Attention
from arcade_torch.models.memory import Memory, replay_by_steps

__all__ = ["GRUGate", "GTrXL"]


class GTrXL(Memory):
    """a = g(x, relu(attention(norm(x)))), y = g'(a, relu(W_2 relu(W_1 norm(a)))), with gates g of
    :class:`GRUGate` in the place of sums.

    The attention is :class:`Attention`: one head, the last W steps, positions by rotation (RoPE,
    where the paper adds terms that are learned). Its state is the state: keys and values of the
    window as rings, and the number of steps. The paper keeps the inputs of the layer instead and
    computes keys and values anew in each update; between two updates both are the same.

    Args:
        input_size: D; a linear map to H stands before the layer where the two differ.
        hidden_size: H.
        window: W, number of steps that are looked at, the current one included.
        gate_bias: initial bias of the gates; the larger, the less the layer does at first.

    Raises:
        ValueError: a size or the window is not positive, or the bias no number.

    Source: Parisotto et al. (2019), arXiv 1910.06764, sections 3.1 (order of the norms) and 3.2
        (gates, "GRU-type").
    """

    averages_values = True

    def __init__(
        self, input_size: int, hidden_size: int, *, window: int = 128, gate_bias: float = 2.0
    ) -> None:
        super().__init__(input_size, hidden_size)
        check_numbers(gate_bias=gate_bias)
        same = input_size == hidden_size
        self.embed = nn.Identity() if same else nn.Linear(input_size, hidden_size, bias=False)
        self.attention_norm = nn.LayerNorm(hidden_size)
        self.attention = Attention(hidden_size, hidden_size, window=window)
        self.attention_gate = GRUGate(hidden_size, gate_bias)
        self.feedforward = nn.Sequential(
            nn.LayerNorm(hidden_size),
            nn.Linear(hidden_size, hidden_size),
            nn.ReLU(),
            nn.Linear(hidden_size, hidden_size),
        )
        self.feedforward_gate = GRUGate(hidden_size, gate_bias)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        return self.attention.state_leaves()

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``."""
        self._check(x, state, is_init)
        x = self.embed(x)
        seen, after = self.attention(self.attention_norm(x), state, is_init)
        x = self.attention_gate(x, F.relu(seen))
        return self.feedforward_gate(x, F.relu(self.feedforward(x))), after

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``; step by step (slow), as in :class:`Attention`."""
        self._check(x, stored, is_init, batch_ndim=2)
        return replay_by_steps(self, x, stored, is_init)


class GRUGate(nn.Module):
    """r, z = sigmoid(W y + U x - (0, b)), c = tanh(W_c y + U_c (r x)), g(x, y) = (1 - z) x + z c.

    Args:
        size: H.
        bias: b at first.
    """

    def __init__(self, size: int, bias: float) -> None:
        super().__init__()
        self.from_new = nn.Linear(size, 3 * size, bias=False)
        self.from_old = nn.Linear(size, 2 * size, bias=False)
        self.candidate_from_old = nn.Linear(size, size, bias=False)
        self.bias = nn.Parameter(torch.full((size,), bias))

    def forward(self, old: Tensor, new: Tensor) -> Tensor:
        """Both [..., H]."""
        r, z, c = self.from_new(new).chunk(3, dim=-1)
        to_r, to_z = self.from_old(old).chunk(2, dim=-1)
        z = torch.sigmoid(z + to_z - self.bias)
        c = torch.tanh(c + self.candidate_from_old(torch.sigmoid(r + to_r) * old))
        return torch.lerp(old, c, z)
