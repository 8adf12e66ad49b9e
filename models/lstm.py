"""Long short-term memory, the same function as torch's."""

import math
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.memory import Memory
from arcade_torch.models.sequential import (
    Loads,
    in_time_order,
    later_starts,
    linear_backward,
    one_by_one,
    start_and_stored,
    time_first,
)

__all__ = ["LSTM", "lstm_loop", "lstm_scan", "lstm_scan_backward"]

# with less for each, calls of torch's LSTM are no faster
STEPS_PER_CALL = 8
ROWS_PER_CALL = 64  # steps times batch
OPTIONS = (True, 1, 0.0, True, False, True)
"""Of torch's LSTM: biases, one layer, no dropout, fit for a backward pass, one direction, batch
first."""


class LSTM(Memory):
    """i, f, o = sigmoid(W x + U h + b), g = tanh(W_g x + U_g h + b_g), c' = f c + i g, h' = o
    tanh(c'), y = h'.

    Sequential in time. Equal to ``torch.nn.LSTM`` with one layer whose two biases are added up,
    with its order of gates (i, f, g, o) and its range of initial weights, and with starts in the
    middle of a sequence, which torch's has not. TorchRL's ``LSTMModule`` runs torch's.

    The state ``"h"`` is h and c in one tensor [2, H]. The loop over time is one operator, so a
    graph that ``torch.compile`` makes does not depend on the length. It has first derivatives only.
    On a CPU, in float32, with few starts, torch's own operator takes its place, which knows of no
    starts: it is called once between any two of them.

    Args:
        input_size: D.
        hidden_size: H.

    Raises:
        ValueError: sizes not positive.

    Source: Hochreiter and Schmidhuber (1997), Neural Computation 9(8); with the forget gate of Gers
        et al. (2000), Neural Computation 12(10).
    """

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size)
        self.state_shape = (2, hidden_size)
        self.from_input = nn.Linear(input_size, 4 * hidden_size)
        self.from_state = nn.Linear(hidden_size, 4 * hidden_size, bias=False)
        bound = 1 / math.sqrt(hidden_size)
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -bound, bound)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See :class:`MemoryContract`."""
        self._check(x, state, is_init)
        h0 = state["h"]
        starts = later_starts(is_init) if _has_fused(x) else None
        if starts is not None and _are_few(starts, len(x), x.shape[1]):
            y, last = self._run_torchs(x, h0, is_init, starts)
        else:
            y, states = self.run(x, h0, is_init)
            last = states[:, -1].clone()  # y may be the same memory
        return y, TensorDict({"h": last}, batch_size=[len(x)])

    def _run_torchs(
        self, x: Tensor, h0: Tensor, is_init: Tensor, starts: list[int]
    ) -> tuple[Tensor, Tensor]:
        """y [B, T, H] and the last state [B, 2, H] by ``torch.lstm``, which keeps no other c."""
        bias = self.from_input.bias
        weights = (self.from_input.weight, self.from_state.weight, bias, torch.zeros_like(bias))
        state = h0.transpose(0, 1)
        outputs = []
        for begin, end in pairwise([0, *starts, x.shape[1]]):
            h, c = torch.where(is_init[:, begin, None], 0, state).split(1)
            y, *after = torch.lstm(x[:, begin:end], (h, c), weights, *OPTIONS)
            state = torch.cat(after)
            outputs.append(y)
        return torch.cat(outputs, dim=1), state.transpose(0, 1)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., 2, H]."""
        start, stored = start_and_stored(h0, is_init, 2, x.dtype)
        scan: Any = lstm_loop if x.shape[1] == 1 else lstm_scan
        weights = (self.from_input.weight, self.from_input.bias, self.from_state.weight)
        states = scan(x, *weights, start, stored)[0]
        return states[:, :, 0], states


def _has_fused(x: Tensor) -> bool:
    """Whether torch's LSTM is one fused operator here, and flags may be read to cut a sequence.

    Not on a card, which would be waited for, nor where a graph is made of the calls, nor in
    transforms such as ``vmap``, for which torch's operator has no rule.
    """
    if x.device.type != "cpu" or x.dtype != torch.float32 or x.shape[1] == 1:
        return False
    if torch.compiler.is_compiling() or torch._C._is_tracing():
        return False
    if torch._C._are_functorch_transforms_active():
        return False
    return torch.backends.mkldnn.is_available() and bool(torch.backends.mkldnn.enabled)


def _are_few(starts: list[int], batch: int, steps: int) -> bool:
    """Whether torch's LSTM, called once between any two starts, is faster than our loop."""
    calls = 1 + len(starts)
    return calls * max(STEPS_PER_CALL * batch, ROWS_PER_CALL) <= batch * steps


def lstm_loop(
    x: Tensor,
    input_weight: Tensor,
    input_bias: Tensor,
    weight: Tensor,
    start: Tensor,
    stored: Tensor,
) -> tuple[Tensor, Tensor]:
    """The recurrence in plain torch operators: what acting runs, and the oracle of
    :func:`lstm_scan`.

    Args:
        x: float [B, T, D].
        input_weight: W and W_g, [4 H, D]: what the input adds to i, f, g and o.
        input_bias: [4 H].
        weight: U, [4 H, H].
        start: bool [B, T], where a state is loaded; set at index 0.
        stored: h and c to load there, [B, T, 2, H] or [B, 1, 2, H]; see :class:`Loads`.

    Returns:
        (h and c after each step [B, T, 2, H], the gates i, f, g and o [B, T, 4 H]).
    """
    steps = F.linear(x, input_weight, input_bias)
    begins = start[..., None, None].unbind(1)
    if stored.shape[1] < start.shape[1]:
        stored = F.pad(stored, (0, 0, 0, 0, 0, start.shape[1] - 1))
    fresh = stored.unbind(1)
    states = []
    gates = []
    state = fresh[0]
    for t, from_input in enumerate(steps.unbind(1)):
        if t > 0:
            state = torch.where(begins[t], fresh[t], state)
        h, c = state.unbind(1)
        i, f, g, o = torch.addmm(from_input, h, weight.t()).chunk(4, dim=-1)
        i_and_f = torch.sigmoid(torch.cat([i, f], dim=-1))
        i, f = i_and_f.chunk(2, dim=-1)
        g = torch.tanh(g)
        o = torch.sigmoid(o)
        c = f * c + i * g
        state = torch.stack([o * torch.tanh(c), c], dim=1)
        states.append(state)
        gates.append(torch.cat([i_and_f, g, o], dim=-1))
    return torch.stack(states, dim=1), torch.stack(gates, dim=1)


@torch.library.custom_op("arcade_torch::lstm_scan", mutates_args=())
def lstm_scan(
    x: Tensor,
    input_weight: Tensor,
    input_bias: Tensor,
    weight: Tensor,
    start: Tensor,
    stored: Tensor,
) -> tuple[Tensor, Tensor]:
    """:func:`lstm_loop` as one operator; gradients flow from the states, not from the gates.

    What the input adds is computed step by step where the gates are to stand, while the processor
    has them near.
    """
    size = weight.shape[1]
    loads = Loads(start, stored)
    from_input = input_weight.t().contiguous()
    from_state = weight.t().contiguous()
    states = time_first(x, 2, size)
    gates = time_first(x, 4 * size)
    i_and_f = gates[..., : 2 * size].unbind(1)
    i, f, g, o = (gate.unbind(1) for gate in gates.split(size, dim=-1))
    after = states.unbind(1)
    of_step = gates.unbind(1)
    state = loads.first
    for t, x_t in enumerate(x.unbind(1)):
        state = loads.apply(t, state)
        torch.addmm(input_bias, x_t, from_input, out=of_step[t])
        of_step[t].addmm_(state[:, 0], from_state)
        i_and_f[t].sigmoid_()
        g[t].tanh_()
        o[t].sigmoid_()
        h, c = after[t].unbind(1)
        torch.mul(f[t], state[:, 1], out=c).addcmul_(i[t], g[t])
        torch.tanh(c, out=h).mul_(o[t])
        state = after[t]
    return states, gates


@torch.library.custom_op("arcade_torch::lstm_scan_backward", mutates_args=())
def lstm_scan_backward(
    weight: Tensor, start: Tensor, stored: Tensor, states: Tensor, gates: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to what the input adds to i, f, g and o [B, T, 4 H] and to ``weight``
    and ``stored`` of :func:`lstm_scan`, from what it took and returned, and the gradient
    [B, T, 2, H] that arrives at the states.
    """
    size = weight.shape[1]
    loads = Loads(start, stored)
    before = loads.before(states)
    d_steps = time_first(gates, 4 * size)
    d_stored = stored.new_zeros(stored.shape)
    i, f, g, o = (x.unbind(1) for x in gates.split(size, dim=-1))
    to_i, to_f, to_g, to_o = (x.unbind(1) for x in d_steps.split(size, dim=-1))
    arrives = grad.unbind(1)
    to_gates = d_steps.unbind(1)
    sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input
    tanh_backward = torch.ops.aten.tanh_backward.grad_input
    carried = torch.zeros_like(states[:, 0])
    d_state = torch.empty_like(carried)
    d_h, d_c = d_state.unbind(1)
    squashed = torch.empty_like(d_h)
    part = torch.empty_like(d_h)
    for t in range(len(arrives) - 1, -1, -1):
        torch.add(arrives[t], carried, out=d_state)
        torch.tanh(states[:, t, 1], out=squashed)
        torch.mul(d_h, squashed, out=part)
        sigmoid_backward(part, o[t], grad_input=to_o[t])
        torch.mul(d_h, o[t], out=part)
        d_c += tanh_backward(part, squashed, grad_input=squashed)
        sigmoid_backward(torch.mul(d_c, g[t], out=part), i[t], grad_input=to_i[t])
        sigmoid_backward(torch.mul(d_c, before[:, t, 1], out=part), f[t], grad_input=to_f[t])
        tanh_backward(torch.mul(d_c, i[t], out=part), g[t], grad_input=to_g[t])
        torch.mm(to_gates[t], weight, out=carried[:, 0])
        torch.mul(d_c, f[t], out=carried[:, 1])
        loads.collect(t, carried, d_stored)
    d_weight = in_time_order(d_steps).t() @ in_time_order(before[:, :, 0])
    return d_steps, d_weight, d_stored


@lstm_scan.register_fake
def _(x: Tensor, input_weight: Tensor, *rest: Tensor) -> Any:
    size = input_weight.shape[0] // 4
    return time_first(x, 2, size), time_first(x, 4 * size)


@lstm_scan_backward.register_fake
def _(
    weight: Tensor, start: Tensor, stored: Tensor, states: Tensor, gates: Tensor, grad: Tensor
) -> Any:
    d_steps = time_first(states, 4 * weight.shape[1])
    return d_steps, *(x.new_empty(x.shape) for x in (weight, stored))


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    x, input_weight, _, *rest = inputs
    ctx.save_for_backward(x, input_weight, *rest, *output)


def _differentiate(ctx: Any, grad: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
    if grad is None:
        return (None,) * 6
    x, input_weight, *rest = ctx.saved_tensors
    d_steps, d_weight, d_stored = lstm_scan_backward(*rest, grad)
    d_input = linear_backward(x, input_weight, d_steps, ctx.needs_input_grad[0])
    return *d_input, d_weight, None, d_stored


lstm_scan.register_autograd(_differentiate, setup_context=_save)
lstm_scan.register_vmap(one_by_one(lstm_scan))
lstm_scan_backward.register_vmap(one_by_one(lstm_scan_backward))
