"""Gated recurrent unit, the paper's variant (not torch's)."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.memory import Memory
from arcade_torch.models.sequential import (
    Loads,
    in_time_order,
    linear_backward,
    one_by_one,
    start_and_stored,
    time_first,
)

__all__ = ["GRU", "gru_loop", "gru_scan", "gru_scan_backward"]


class GRU(Memory):
    """z, r = sigmoid(W x + U h), c = tanh(W_h x + U_h (r h)), h' = (1 - z) h + z c, y = h'.

    Sequential in time. Not ``torch.nn.GRU``: the reset gate acts on h *before* U_h, z has the other
    sense, and U has no bias.

    The loop over time is one operator, so a graph that ``torch.compile`` makes does not depend on
    the length. It has first derivatives only.

    Args:
        input_size: D.
        hidden_size: H.

    Raises:
        ValueError: sizes not positive.

    Source: POPGym Arcade, appendix on memory models; Cho et al. (2014), arXiv 1406.1078, eqs. 5 to
        8 (with z and 1 - z exchanged).
    """

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size)
        self.state_shape = (hidden_size,)
        self.from_input = nn.Linear(input_size, 3 * hidden_size)
        self.gates_from_state = nn.Linear(hidden_size, 2 * hidden_size, bias=False)
        self.candidate_from_state = nn.Linear(hidden_size, hidden_size, bias=False)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`."""
        start, stored = start_and_stored(h0, is_init, 1, x.dtype)
        scan: Any = gru_loop if x.shape[1] == 1 else gru_scan
        weights = (
            self.from_input.weight,
            self.from_input.bias,
            self.gates_from_state.weight,
            self.candidate_from_state.weight,
        )
        y = scan(x, *weights, start, stored)[0]
        return y, y


def gru_loop(
    x: Tensor,
    input_weight: Tensor,
    input_bias: Tensor,
    gates_weight: Tensor,
    candidate_weight: Tensor,
    start: Tensor,
    stored: Tensor,
) -> tuple[Tensor, Tensor]:
    """The recurrence in plain torch operators: what acting runs, and the oracle of
    :func:`gru_scan`.

    Args:
        x: float [B, T, D].
        input_weight: W and W_h, [3 H, D]: what the input adds to z, r and c.
        input_bias: [3 H].
        gates_weight: U, [2 H, H].
        candidate_weight: U_h, [H, H].
        start: bool [B, T], where a state is loaded; set at index 0.
        stored: what is loaded, [B, T, H] or [B, 1, H]; see :class:`Loads`.

    Returns:
        (the state after each step [B, T, H], z, r and c [B, T, 3 H]).
    """
    size = candidate_weight.shape[0]
    steps = F.linear(x, input_weight, input_bias)
    begins = start.unsqueeze(-1).unbind(1)
    if stored.shape[1] > 1:
        fresh = stored.expand_as(steps[..., :size])
    else:
        fresh = F.pad(stored, (0, 0, 0, steps.shape[1] - 1))
    states = []
    gates = []
    h = stored[:, 0]
    for t, from_input in enumerate(steps.unbind(1)):
        if t > 0:
            h = torch.where(begins[t], fresh[:, t], h)
        to_gates, to_candidate = from_input.split([2 * size, size], dim=-1)
        z_and_r = torch.sigmoid(torch.addmm(to_gates, h, gates_weight.t()))
        z, r = z_and_r.chunk(2, dim=-1)
        c = torch.tanh(torch.addmm(to_candidate, r * h, candidate_weight.t()))
        h = torch.lerp(h, c, z)
        states.append(h)
        gates.append(torch.cat([z_and_r, c], dim=-1))
    return torch.stack(states, dim=1), torch.stack(gates, dim=1)


@torch.library.custom_op("arcade_torch::gru_scan", mutates_args=())
def gru_scan(
    x: Tensor,
    input_weight: Tensor,
    input_bias: Tensor,
    gates_weight: Tensor,
    candidate_weight: Tensor,
    start: Tensor,
    stored: Tensor,
) -> tuple[Tensor, Tensor]:
    """:func:`gru_loop` as one operator; gradients flow from the states, not from z, r and c.

    What the input adds is computed step by step where the gates are to stand, while the processor
    has them near.
    """
    size = candidate_weight.shape[0]
    loads = Loads(start, stored)
    from_input = input_weight.t().contiguous()
    to_z_and_r = gates_weight.t().contiguous()
    to_c = candidate_weight.t().contiguous()
    states = time_first(x, size)
    gates = time_first(x, 3 * size)
    of_step = gates.unbind(1)
    z_and_r = gates[..., : 2 * size].unbind(1)
    z, r, c = (gate.unbind(1) for gate in gates.split(size, dim=-1))
    after = states.unbind(1)
    h = loads.first
    reset = torch.empty_like(h)
    for t, x_t in enumerate(x.unbind(1)):
        h = loads.apply(t, h)
        torch.addmm(input_bias, x_t, from_input, out=of_step[t])
        z_and_r[t].addmm_(h, to_z_and_r).sigmoid_()
        torch.mul(r[t], h, out=reset)
        c[t].addmm_(reset, to_c).tanh_()
        h = torch.lerp(h, c[t], z[t], out=after[t])
    return states, gates


@torch.library.custom_op("arcade_torch::gru_scan_backward", mutates_args=())
def gru_scan_backward(
    gates_weight: Tensor,
    candidate_weight: Tensor,
    start: Tensor,
    stored: Tensor,
    states: Tensor,
    gates: Tensor,
    grad: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients with respect to what the input adds to z, r and c [B, T, 3 H] and to
    ``gates_weight``, ``candidate_weight`` and ``stored`` of :func:`gru_scan`, from what it took and
    returned, and the gradient [B, T, H] that arrives at the states.
    """
    size = candidate_weight.shape[0]
    loads = Loads(start, stored)
    before = loads.before(states)
    d_steps = time_first(gates, 3 * size)
    d_stored = stored.new_zeros(stored.shape)
    d_h = torch.empty_like(loads.first)
    d_reset = torch.empty_like(d_h)
    d_candidate = torch.empty_like(d_h)
    d_gates = gates.new_empty(d_h.shape[0], 2 * size)
    d_z, d_r = d_gates.split(size, dim=1)
    carried = torch.zeros_like(d_h)
    z, r, c = (x.unbind(1) for x in gates.split(size, dim=-1))
    z_and_r = gates[..., : 2 * size].unbind(1)
    to_gates = d_steps[..., : 2 * size].unbind(1)
    to_c = d_steps[..., 2 * size :].unbind(1)
    arrives = grad.unbind(1)
    read = before.unbind(1)
    for t in range(len(arrives) - 1, -1, -1):
        torch.add(arrives[t], carried, out=d_h)
        torch.mul(d_h, z[t], out=d_candidate)
        torch.ops.aten.tanh_backward.grad_input(d_candidate, c[t], grad_input=to_c[t])
        torch.mm(to_c[t], candidate_weight, out=d_reset)
        torch.sub(c[t], read[t], out=d_z).mul_(d_h)
        torch.mul(d_reset, read[t], out=d_r)
        torch.ops.aten.sigmoid_backward.grad_input(d_gates, z_and_r[t], grad_input=to_gates[t])
        torch.sub(d_h, d_candidate, out=carried).addcmul_(d_reset, r[t])
        carried.addmm_(to_gates[t], gates_weight)
        loads.collect(t, carried, d_stored)
    rows = in_time_order(d_steps)
    d_gates_weight = rows[:, : 2 * size].t() @ in_time_order(before)
    before *= gates[..., size : 2 * size]  # the reset state, in the same memory
    d_candidate_weight = rows[:, 2 * size :].t() @ in_time_order(before)
    return d_steps, d_gates_weight, d_candidate_weight, d_stored


@gru_scan.register_fake
def _(x: Tensor, input_weight: Tensor, *rest: Tensor) -> Any:
    size = input_weight.shape[0] // 3
    return time_first(x, size), time_first(x, 3 * size)


@gru_scan_backward.register_fake
def _(
    gates_weight: Tensor, candidate_weight: Tensor, start: Tensor, stored: Tensor, *rest: Tensor
) -> Any:
    weights = (gates_weight, candidate_weight, stored)
    d_steps = time_first(rest[0], 3 * candidate_weight.shape[0])
    return d_steps, *(x.new_empty(x.shape) for x in weights)


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    x, input_weight, _, *rest = inputs
    ctx.save_for_backward(x, input_weight, *rest, *output)


def _differentiate(ctx: Any, grad: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
    if grad is None:
        return (None,) * 7
    x, input_weight, *rest = ctx.saved_tensors
    d_steps, *d_weights, d_stored = gru_scan_backward(*rest, grad)
    d_input = linear_backward(x, input_weight, d_steps, ctx.needs_input_grad[0])
    return *d_input, *d_weights, None, d_stored


gru_scan.register_autograd(_differentiate, setup_context=_save)
gru_scan.register_vmap(one_by_one(gru_scan))
gru_scan_backward.register_vmap(one_by_one(gru_scan_backward))
