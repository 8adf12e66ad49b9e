"""RWKV-7 (Goose): a matrix memory whose rows forget at rates of their own, with a delta rule."""

import math
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.fast_weights import unit_length
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan_dplr import dplr_loop, dplr_scan
from arcade_torch.models.sequential import start_and_stored

__all__ = ["RWKV7"]

PARTS = 6  # r, k, v, w, a and g: what a step computes from the input
LARGEST_RATE = math.exp(-0.5)  # of decay: w lies between exp(-exp(-0.5)) = 0.545 and 1


class RWKV7(Memory):
    """S_t = diag(w_t) S_{t-1} - (a_t n_t) (n_t^T S_{t-1}) + k'_t v_t^T and y_t = W_o (g_t p_t),
    with p_t = LN(S_t^T r_t) + (r_t . (rho k'_t)) v_t.

    w = exp(-exp(-0.5) sigmoid(.)), a = sigmoid(.) and g = sigmoid(.); n is k xi at length one, k' =
    k (1 + alpha (a - 1)); r, k, v and what stands for a dot are linear maps of the input mixed with
    the one before, x + mu (x_before - x), with a mu for each. S is the transpose of the paper's.

    One head of side K and no other block, because a network here has its own. Differs from the
    paper by plain linear maps where it has low-rank ones (K is small already), so that w lacks the
    tanh between two maps and g has its sigmoid behind the map, and by the value of the first
    layer, which later layers look at there. Sequential in time: the loop is one operator,
    with first derivatives only.

    The state is ``"h"`` [K, K] and ``"x"`` [D], the input before.

    Args:
        input_size: D.
        hidden_size: H.
        key_size: K; None is the integer nearest to sqrt(H).

    Raises:
        ValueError: a size is not positive.

    Source: Peng et al. (2025), arXiv 2503.14456, section 4.
    """

    def __init__(self, input_size: int, hidden_size: int, *, key_size: int | None = None) -> None:
        super().__init__(input_size, hidden_size)
        size = max(1, round(math.sqrt(hidden_size))) if key_size is None else key_size
        check_sizes(key_size=size)
        if size < 1:
            raise ValueError(f"key_size must be positive, got {key_size}")
        self.key_size = size
        self.state_shape = (size, size)
        bound = 1 / math.sqrt(input_size)
        self.weight = nn.Parameter(torch.empty(PARTS, size, input_size).uniform_(-bound, bound))
        self.mix = nn.Parameter(torch.full((PARTS, 1, input_size), 0.5))
        self.bias = nn.Parameter(torch.linspace(-6, 0, size))  # of w: from slow to fast
        self.bias_a = nn.Parameter(torch.zeros(size))
        self.xi = nn.Parameter(torch.ones(size))
        self.alpha = nn.Parameter(torch.ones(size))
        self.rho = nn.Parameter(torch.zeros(size))
        self.norm = nn.LayerNorm(size)
        self.output = nn.Linear(size, hidden_size)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        return super().state_leaves() | {"x": ((self.input_size,), None)}

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``."""
        self._check(x, state, is_init)
        y, h = self._read(x, state, is_init)
        last = {"h": h[:, -1].clone(), "x": x[:, -1].clone()}
        return y, TensorDict(last, batch_size=[x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``."""
        self._check(x, stored, is_init, batch_ndim=2)
        y, h = self._read(x, stored, is_init)
        return y, TensorDict({"h": h, "x": x.clone()}, batch_size=x.shape[:2])

    def _read(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs, and the matrix after each step."""
        start, stored = start_and_stored(state["x"], is_init, 1, x.dtype)
        one_before = F.pad(x, (0, 0, 1, 0))[:, :-1]
        loaded = F.pad(stored, (0, 0, 0, x.shape[1] - stored.shape[1]))
        change = torch.where(start.unsqueeze(-1), loaded, one_before) - x
        mixed = (self.weight * self.mix).flatten(0, 1)
        parts = F.linear(x, self.weight.flatten(0, 1)) + F.linear(change, mixed)
        r, k, v, w, a, g = parts.chunk(PARTS, dim=-1)

        w = torch.exp(-LARGEST_RATE * torch.sigmoid(w + self.bias))
        a = torch.sigmoid(a + self.bias_a)
        n = unit_length(k * self.xi)
        k = k * (1 + self.alpha * (a - 1))
        start, stored = start_and_stored(state["h"], is_init, 2, x.dtype)
        scan: Any = dplr_loop if x.shape[1] == 1 else dplr_scan
        h = scan(w, a * n, n, k, v, start, stored)
        read = self.norm((r.unsqueeze(-2) @ h).squeeze(-2))
        read = read + torch.linalg.vecdot(r, self.rho * k).unsqueeze(-1) * v
        return self.output(torch.sigmoid(g) * read), h
