"""Stable Hadamard Memory: a matrix every entry of which has a gate of its own."""

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["StableHadamardMemory"]

EPSILON = 1e-5  # of the sums by which keys and queries are divided


class StableHadamardMemory(Memory):
    """M_t = M_{t-1} * C_t + eta_t v_t k_t^T with C_t = 1 + tanh(theta_t c_t^T), y_t = W M_t q_t,
    where * goes entry by entry.

    k and q are relu of linear maps, divided by their sums; v and c are linear, eta is the sigmoid
    of a number; all of the layer-normed input. A gate lies in (0, 2): it weakens or strengthens.

    The paper draws theta_t from L learned rows at random, so that the gates have mean one. Acting
    and learning could then not agree. Here step t of an episode takes row t modulo L, and rows are
    used less their mean: log(1 + tanh) is concave, so over L steps with the same c no entry can
    have grown. Published code draws a number from [0, 1) and rounds it down: always row 0.

    The state is ``"h"`` [K, K] and ``"step"`` int64 [], the steps of the episode.

    Args:
        input_size: D.
        hidden_size: H.
        key_size: K; None is the integer nearest to sqrt(H).
        rows: L.

    Raises:
        ValueError: a size is not positive.

    Source: Le et al. (2024), arXiv 2410.10132, section 3; code: thaihungle/SHM, ``ray_shm.py``.
    """

    scan = staticmethod(linear_scan)

    def __init__(
        self, input_size: int, hidden_size: int, *, key_size: int | None = None, rows: int = 128
    ) -> None:
        super().__init__(input_size, hidden_size)
        self.key_size = max(1, round(math.sqrt(hidden_size))) if key_size is None else key_size
        check_sizes(key_size=self.key_size, rows=rows)
        if self.key_size < 1 or rows < 1:
            raise ValueError(f"key_size and rows must be positive, got {key_size} and {rows}")
        self.state_shape = (self.key_size, self.key_size)
        self.norm = nn.LayerNorm(input_size)
        self.from_input = nn.Linear(input_size, 4 * self.key_size + 1, bias=False)
        self.theta = nn.Parameter(nn.init.xavier_uniform_(torch.empty(rows, self.key_size)))
        self.output = nn.Linear(self.key_size, hidden_size)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        return super().state_leaves() | {"step": ((), torch.int64)}

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``."""
        self._check(x, state, is_init)
        y, states = self._read(x, state, is_init)
        last = {name: leaf[:, -1].clone() for name, leaf in states.items()}
        return y, TensorDict(last, batch_size=[x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``."""
        self._check(x, stored, is_init, batch_ndim=2)
        y, states = self._read(x, stored, is_init)
        return y, TensorDict(states, batch_size=x.shape[:2])

    def _read(
        self, x: Tensor, state: TensorDict, is_init: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Outputs, and the state after each step."""
        one = torch.ones_like(is_init, dtype=torch.int64)
        step = linear_scan(one, one, is_init, state["step"])
        sizes = [self.key_size] * 4 + [1]
        query, key, value, gate, strength = self.from_input(self.norm(x)).split(sizes, dim=-1)
        query = F.relu(query)
        key = F.relu(key)
        query = query / (query.sum(-1, keepdim=True) + EPSILON)
        key = key / (key.sum(-1, keepdim=True) + EPSILON)
        rows = self.theta - self.theta.mean(0)
        theta = rows[(step - 1) % rows.shape[0]]
        gates = 1 + torch.tanh(theta.unsqueeze(-1) * gate.unsqueeze(-2))
        written = (torch.sigmoid(strength) * value).unsqueeze(-1) * key.unsqueeze(-2)
        h = self.scan(gates, written, is_init, state["h"])
        y: Tensor = self.output((h @ query.unsqueeze(-1)).squeeze(-1))
        return y, {"h": h, "step": step}
