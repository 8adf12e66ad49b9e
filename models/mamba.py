"""Mamba: a diagonal state-space model whose step, input and read-out depend on the input."""

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.frame_stack import last_inputs
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan import linear_scan

__all__ = ["Mamba"]

DT_RANGE = (0.001, 0.1)  # of the initial steps
DT_LEAST = 1e-4


class Mamba(Memory):
    """h_t = exp(Delta_t A) h_{t-1} + Delta_t B_t u_t, y_t = W (C_t h_t + D u_t) silu(z_t), where u
    = silu(a causal convolution of P x over the last steps), z = Q x.

    Delta = softplus(W_2 W_1 u + b) is one number a channel, B and C are linear in u and shared by
    the channels; A = -exp(.) is [N, E] and begins with -1, ..., -N in every channel.

    The state is ``"h"`` [N, E] and, because of the convolution, ``"conv"``, the last inputs of it
    [k - 1, E], the newest first. Published code for inference carries both; a convolution that
    begins with zeros in every chunk, or runs on across a start, is another function.

    Args:
        input_size: D.
        hidden_size: H.
        state_size: N, numbers a channel; the paper has 16.
        expand: E / H; the paper has 2.
        conv: k, steps that the convolution sees, with the current one; at least 2.

    Raises:
        ValueError: a size is not positive, or ``conv`` below 2.

    Source: Gu and Dao (2023), arXiv 2312.00752, algorithm 2 and section 3.4; initial values of
        section 3.6.
    """

    scan = staticmethod(linear_scan)

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        state_size: int = 8,
        expand: int = 1,
        conv: int = 4,
    ) -> None:
        super().__init__(input_size, hidden_size)
        check_sizes(state_size=state_size, expand=expand, conv=conv)
        if state_size < 1 or expand < 1:
            raise ValueError(
                f"sizes must be positive, got state_size={state_size}, expand={expand}"
            )
        if conv < 2:
            raise ValueError(
                f"conv must be at least 2 (the current step and the one before), got {conv}"
            )
        self.state_size = state_size
        self.conv = conv
        self.width = expand * hidden_size
        self.rank = math.ceil(hidden_size / 16)
        self.signal_and_gate = nn.Linear(input_size, 2 * self.width, bias=False)
        bound = 1 / math.sqrt(conv)
        self.taps = nn.Parameter(torch.empty(conv, self.width).uniform_(-bound, bound))
        self.taps_bias = nn.Parameter(torch.empty(self.width).uniform_(-bound, bound))
        self.selection = nn.Linear(self.width, self.rank + 2 * state_size, bias=False)
        self.step = nn.Linear(self.rank, self.width)
        nn.init.uniform_(self.step.weight, -(self.rank**-0.5), self.rank**-0.5)
        low, high = map(math.log, DT_RANGE)
        first = torch.exp(low + (high - low) * torch.rand(self.width)).clamp_min(DT_LEAST)
        with torch.no_grad():  # softplus of it is ``first``
            self.step.bias.copy_(first + torch.log(-torch.expm1(-first)))
        rates = torch.arange(1.0, state_size + 1).unsqueeze(-1).expand(-1, self.width)
        self.log_rate = nn.Parameter(rates.log().clone())
        self.skip = nn.Parameter(torch.ones(self.width))
        self.output = nn.Linear(self.width, hidden_size, bias=False)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        h = (self.state_size, self.width)
        return {"h": (h, None), "conv": ((self.conv - 1, self.width), None)}

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``."""
        self._check(x, state, is_init)
        y, h, window = self._read(x, state, is_init)
        last = {"h": h[:, -1].to(x.dtype, copy=True), "conv": window[:, -1, :-1].clone()}
        return y, TensorDict(last, batch_size=[x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``."""
        self._check(x, stored, is_init, batch_ndim=2)
        y, h, window = self._read(x, stored, is_init)
        states = {"h": h.to(x.dtype), "conv": window[:, :, :-1]}
        return y, TensorDict(states, batch_size=x.shape[:2])

    def _read(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(y [B, T, H], h after each step [B, T, N, E], what the convolution saw [B, T, k, E])."""
        exact = torch.promote_types(x.dtype, torch.float32)  # products of many factors
        signal, gate = self.signal_and_gate(x).chunk(2, dim=-1)
        window = last_inputs(signal, state["conv"], is_init)
        u = F.silu((window * self.taps).sum(dim=2) + self.taps_bias)
        sizes = [self.rank, self.state_size, self.state_size]
        low, to_state, from_state = self.selection(u).split(sizes, dim=-1)
        delta = F.softplus(self.step(low)).to(exact)
        decay = torch.exp(delta.unsqueeze(-2) * -torch.exp(self.log_rate.to(exact)))
        given = to_state.to(exact).unsqueeze(-1) * (delta * u).unsqueeze(-2)
        h = self.scan(decay, given, is_init, state["h"].to(exact))
        y = (from_state.to(exact).unsqueeze(-2) @ h).squeeze(-2).to(x.dtype) + self.skip * u
        return self.output(y * F.silu(gate)), h, window

    def extra_repr(self) -> str:
        """Sizes and options, for printing."""
        return f"{super().extra_repr()}, state_size={self.state_size}, conv={self.conv}"
