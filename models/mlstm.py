"""mLSTM: a matrix memory with exponential gates, stabilised, in chunks."""

import math
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan_matrix import MatrixSteps, matrix_scan, matrix_scan_stored

__all__ = ["MLSTM", "decayed_max"]

SLOW_FORGETTING = 4.0  # bias of the forget gate: sigmoid of it is 0.98
FLOOR = 1e-6  # least denominator, as a share of the largest weight; the authors' code adds it


class MLSTM(Memory):
    """C_t = f C_{t-1} + i v k^T, n_t = f n_{t-1} + i k, y = W (o * C_t q / max(\\|n_t . q\\|, 1)),
    i = exp(a . x + b), f = sigmoid(c . x + d), o = sigmoid(O x + e).

    q, k and v are linear in x, k divided by sqrt(K); one head. exp(i) may be any size, so the state
    holds C and n times exp(-m), with the running maximum m_t = max(log f + m_{t-1}, log i, 0): the
    paper's, but never below 0, where nothing needs it and exp(-m) could overflow. y does not
    depend on m, so no gradient flows through it. With it all factors are at most 1 and the chunks
    of :func:`matrix_scan` do the rest.

    The state is ``"h"`` [K, K + 1], the transpose of C and n as its last column, and ``"m"`` [].

    Args:
        input_size: D.
        hidden_size: H.
        key_size: K; None is the integer nearest to sqrt(H).

    Raises:
        ValueError: a size is not positive.

    Source: Beck et al. (2024), arXiv 2405.04517, eqs. 19 to 27, with the stabiliser of eqs. 15 to
        17.
    """

    def __init__(self, input_size: int, hidden_size: int, *, key_size: int | None = None) -> None:
        super().__init__(input_size, hidden_size)
        self.key_size = max(1, round(math.sqrt(hidden_size))) if key_size is None else key_size
        check_sizes(key_size=self.key_size)
        if self.key_size < 1:
            raise ValueError(f"key_size must be positive, got {key_size}")
        self.query_key_value = nn.Linear(input_size, 3 * self.key_size)
        self.gates = nn.Linear(input_size, 2)
        nn.init.constant_(self.gates.bias[1:], SLOW_FORGETTING)
        self.output_gate = nn.Linear(input_size, self.key_size)
        self.output = nn.Linear(self.key_size, hidden_size)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        return {"h": ((self.key_size, self.key_size + 1), None), "m": ((), None)}

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``; the memory it needs does not grow with T K K."""
        self._check(x, state, is_init)
        first = torch.where(is_init[:, :1], 0, state["m"].unsqueeze(1))
        steps, m = self._steps(x, F.pad(first, (0, x.shape[1] - 1)), is_init)
        o, h = matrix_scan(steps, is_init, state["h"].to(m.dtype))
        last = self._state(h, m[:, -1], x.dtype)
        return self._read_out(x, o, m), TensorDict(last, batch_size=[x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``."""
        self._check(x, stored, is_init, batch_ndim=2)
        steps, m = self._steps(x, stored["m"], is_init)
        o, h = matrix_scan_stored(steps, is_init, stored["h"].to(m.dtype))
        states = self._state(h, m, x.dtype)
        return self._read_out(x, o, m), TensorDict(states, batch_size=x.shape[:2])

    def _steps(self, x: Tensor, stored: Tensor, is_init: Tensor) -> tuple[MatrixSteps, Tensor]:
        """What every step does to the stabilised matrix, and m after each step [B, T]; ``stored``
        is m where a state is loaded.
        """
        exact = torch.promote_types(x.dtype, torch.float32)
        query, key, value = self.query_key_value(x).to(exact).chunk(3, dim=-1)
        log_i, forget = self.gates(x).to(exact).unbind(-1)
        log_f = F.logsigmoid(forget)
        stored = stored.to(exact)
        begins = is_init | (torch.arange(x.shape[1], device=x.device) == 0)
        with torch.no_grad():
            # what is not finite is lost in matrix_scan, and has no part in the maximum
            decay = log_f.nan_to_num(0, 0, 0)
            given = log_i.nan_to_num(0, 0, 0)
            loaded = stored.nan_to_num(0, 0, 0)
            given = torch.where(begins, given.maximum(decay + loaded), given)
            m = given.clamp_min(0)
            if x.shape[1] > 1:  # not acting
                m = decayed_max(decay, m, begins)
        before = torch.where(begins, stored, F.pad(m, (1, 0))[:, :-1])
        weight = (log_i - m).exp().unsqueeze(-1)
        value = weight * F.pad(value, (0, 1), value=1.0)
        log_decay = (log_f + before - m).unsqueeze(-1)
        return MatrixSteps(query, key / math.sqrt(self.key_size), value, None, log_decay), m

    def _read_out(self, x: Tensor, o: Tensor, m: Tensor) -> Tensor:
        """y [B, T, H] from what the matrix answered [B, T, K + 1]."""
        answer, normaliser = o.split([self.key_size, 1], dim=-1)
        least = torch.exp(-m).clamp_min(FLOOR).unsqueeze(-1)
        answer = (answer / normaliser.abs().maximum(least)).to(x.dtype)
        y: Tensor = self.output(torch.sigmoid(self.output_gate(x)) * answer)
        return y

    def _state(self, h: Tensor, m: Tensor, dtype: torch.dtype) -> dict[str, Tensor]:
        """The leaves; where m is rounded, h makes up for it."""
        rounded = m.to(dtype)
        h = h * (m - rounded.to(m.dtype)).exp()[..., None, None]
        return {"h": h.to(dtype), "m": rounded.clone()}


@torch.library.custom_op("arcade_torch::decayed_max", mutates_args=())
def decayed_max(decay: Tensor, given: Tensor, start: Tensor) -> Tensor:
    """m_t = max(decay_t + m_{t-1}, given_t), and given_t where ``start`` is set; log2(T) passes.

    One operator, so that a compiled graph does not depend on the length; it has no derivative.

    Args:
        decay: float [B, T].
        given: float [B, T].
        start: bool [B, T], set at index 0.

    Returns:
        m [B, T].
    """
    m = given.clone()
    shift = 1
    while shift < m.shape[1]:
        joined = m[:, shift:].maximum(decay[:, shift:] + m[:, :-shift])
        joined = torch.where(start[:, shift:], m[:, shift:], joined)
        m = torch.cat([m[:, :shift], joined], dim=1)
        decay = torch.cat([decay[:, :shift], decay[:, shift:] + decay[:, :-shift]], dim=1)
        start = torch.cat([start[:, :shift], start[:, shift:] | start[:, :-shift]], dim=1)
        shift *= 2
    return m


@decayed_max.register_fake
def _(decay: Tensor, given: Tensor, start: Tensor) -> Tensor:
    return given.new_empty(given.shape)


@decayed_max.register_vmap
def _(info: Any, in_dims: tuple[int | None, ...], *args: Tensor) -> tuple[Tensor, int]:
    size = info.batch_size
    rows = []
    for x, dim in zip(args, in_dims, strict=True):
        mapped = x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
        rows.append(mapped.flatten(0, 1))
    return decayed_max(*rows).unflatten(0, (size, -1)), 0
