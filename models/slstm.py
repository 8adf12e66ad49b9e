"""sLSTM: an LSTM with an exponential input gate, a normaliser and a stabiliser."""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.memory import Memory
from arcade_torch.models.sequential import Loads, one_by_one, start_and_stored

__all__ = ["SLSTM", "slstm_loop", "slstm_scan", "slstm_scan_backward"]

SLOW_FORGETTING = (3.0, 6.0)  # biases of the forget gates: sigmoids are 0.95 to 0.998


class SLSTM(Memory):
    """i = exp(a), f = sigmoid(b), z = tanh(d), o = sigmoid(e) with (a, b, d, e) = W x + R h + bias;
    c' = f c + i z, n' = f n + i, y = h' = o c' / n'.

    c and n are kept times exp(-m), with m' = max(log f + m, log i), so that every factor is at most
    1 and n at least 1. y does not depend on m: gradients take it as a constant. Sequential in time;
    R is one full matrix a gate (the paper's with one head).

    The state ``"h"`` is h, c, n and m in one tensor [4, H]. Where n is 0 nothing is held yet, and m
    is log i whatever it was: the authors' code asks whether *all* n in the batch are 0, so there an
    environment that begins alone is begun with m = 0. The loop over time is one operator, so a
    graph that ``torch.compile`` makes does not depend on the length. It has first derivatives only.

    Args:
        input_size: D.
        hidden_size: H.

    Raises:
        ValueError: sizes not positive.

    Source: Beck et al. (2024), arXiv 2405.04517, eqs. 8 to 17.
    """

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size)
        self.state_shape = (4, hidden_size)
        self.from_input = nn.Linear(input_size, 4 * hidden_size)
        self.from_state = nn.Linear(hidden_size, 4 * hidden_size, bias=False)
        bound = 1 / math.sqrt(hidden_size)
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -bound, bound)
        with torch.no_grad():
            slow = torch.linspace(*SLOW_FORGETTING, hidden_size)
            self.from_input.bias[hidden_size : 2 * hidden_size] = slow

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., 4, H]."""
        steps = self.from_input(x)
        start, stored = start_and_stored(h0, is_init, 2, steps.dtype)
        scan: Any = slstm_loop if x.shape[1] == 1 else slstm_scan
        states = scan(steps, self.from_state.weight.to(steps.dtype), start, stored)[0]
        return states[:, :, 0], states


def slstm_loop(
    steps: Tensor, weight: Tensor, start: Tensor, stored: Tensor
) -> tuple[Tensor, Tensor]:
    """The recurrence in plain torch operators: what acting runs, and the oracle of
    :func:`slstm_scan`.

    Args:
        steps: float [B, T, 4 H], what the input adds to a, b, d and e.
        weight: R, [4 H, H].
        start: bool [B, T], where the state is loaded; set at index 0.
        stored: h, c, n and m to load there, [B, T, 4, H] or [B, 1, 4, H]; see :class:`Loads`.

    Returns:
        (h, c, n and m after each step [B, T, 4, H], the stabilised i and f, z, o and sigmoid(-b)
        [B, T, 5 H]).
    """
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
        h, c, n, m = state.unbind(1)
        log_i, b, z, o = torch.addmm(from_input, h, weight.t()).chunk(4, dim=-1)
        log_f = (F.logsigmoid(b) + m).masked_fill(n == 0, -torch.inf)
        m = torch.maximum(log_f, log_i).detach()
        i = torch.exp(log_i - m)
        f = torch.exp(log_f - m)
        z = torch.tanh(z)
        o = torch.sigmoid(o)
        c = f * c + i * z
        n = f * n + i
        state = torch.stack([o * c / n, c, n, m], dim=1)
        states.append(state)
        gates.append(torch.cat([i, f, z, o, torch.sigmoid(-b)], dim=-1))
    return torch.stack(states, dim=1), torch.stack(gates, dim=1)


@torch.library.custom_op("arcade_torch::slstm_scan", mutates_args=())
def slstm_scan(
    steps: Tensor, weight: Tensor, start: Tensor, stored: Tensor
) -> tuple[Tensor, Tensor]:
    """:func:`slstm_loop` as one operator; gradients flow from the states, not from the gates."""
    return slstm_loop(steps, weight, start, stored)


@torch.library.custom_op("arcade_torch::slstm_scan_backward", mutates_args=())
def slstm_scan_backward(
    weight: Tensor, start: Tensor, stored: Tensor, states: Tensor, gates: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of :func:`slstm_scan` with respect to its float arguments, from what it took and
    returned, and the gradient [B, T, 4, H] that arrives at the states (that at m counts nothing).
    """
    loads = Loads(start, stored)
    before = loads.before(states)
    i, f, z, o, remember = gates.chunk(5, dim=-1)
    n = states[:, :, 2]
    ratio = states[:, :, 1] / n
    # What does not depend on the gradient from later steps, for all steps at once.
    h_to_c = o / n
    h_to_n = -h_to_c * ratio
    h_to_e = ratio * o * (1 - o)
    c_to_d = i * (1 - z * z)
    columns = [h_to_c, h_to_n, h_to_e, c_to_d, i, f, z, remember, before, grad]
    by_step = list(zip(*(x.unbind(1) for x in columns), strict=True))

    grad_steps = torch.empty_like(gates[..., : 4 * n.shape[-1]])
    grad_stored = stored.new_zeros(stored.shape)
    carried = torch.zeros_like(states[:, 0])
    for t in range(grad.shape[1] - 1, -1, -1):
        to_c, to_n, to_e, to_d, i_t, f_t, z_t, rest, before_t, grad_t = by_step[t]
        d_h, d_c, d_n, _ = (grad_t + carried).unbind(1)
        d_c = d_c + d_h * to_c
        d_n = d_n + d_h * to_n
        d_log_f = f_t * (d_c * before_t[:, 1] + d_n * before_t[:, 2])
        d_log_i = i_t * (d_c * z_t + d_n)
        d_steps = torch.cat([d_log_i, d_log_f * rest, d_c * to_d, d_h * to_e], dim=-1)
        carried = torch.stack([d_steps @ weight, d_c * f_t, d_n * f_t, d_log_f], dim=1)
        grad_steps[:, t] = d_steps
        loads.collect(t, carried, grad_stored)
    grad_weight = grad_steps.flatten(0, 1).t() @ before[:, :, 0].flatten(0, 1)
    return grad_steps, grad_weight, grad_stored


@slstm_scan.register_fake
def _(steps: Tensor, weight: Tensor, start: Tensor, stored: Tensor) -> Any:
    size = stored.shape[-1]
    gates = steps.new_empty(*start.shape, 5 * size)
    return steps.new_empty(*start.shape, 4, size), gates


@slstm_scan_backward.register_fake
def _(
    weight: Tensor, start: Tensor, stored: Tensor, states: Tensor, gates: Tensor, grad: Tensor
) -> Any:
    steps = gates.new_empty(*start.shape, 4 * stored.shape[-1])
    return steps, weight.new_empty(weight.shape), stored.new_empty(stored.shape)


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[1:], *output)


def _differentiate(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
    to_steps, to_weight, to_stored = slstm_scan_backward(*ctx.saved_tensors, grad)
    return to_steps, to_weight, None, to_stored


slstm_scan.register_autograd(_differentiate, setup_context=_save)
slstm_scan.register_vmap(one_by_one(slstm_scan))
slstm_scan_backward.register_vmap(one_by_one(slstm_scan_backward))
