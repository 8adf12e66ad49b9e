"""Long short-term memory, the same function as torch's."""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.gru import one_by_one
from arcade_torch.models.memory import Memory

__all__ = ["LSTM", "lstm_loop", "lstm_scan", "lstm_scan_backward"]


class LSTM(Memory):
    """i, f, o = sigmoid(W x + U h + b), g = tanh(W_g x + U_g h + b_g), c' = f c + i g, h' = o
    tanh(c'), y = h'.

    Sequential in time. Equal to ``torch.nn.LSTM`` with one layer whose two biases are added up,
    with its order of gates (i, f, g, o) and its range of initial weights, and with starts in the
    middle of a sequence, which torch's has not. TorchRL's ``LSTMModule`` runs torch's.

    The state ``"h"`` is h and c in one tensor [2, H]. The loop over time is one operator, so a
    graph that ``torch.compile`` makes does not depend on the length. It has first derivatives only.

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

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., 2, H]."""
        steps = self.from_input(x)
        stored = h0.to(steps.dtype)
        if h0.ndim == x.ndim:  # every start but index 0 loads zeros
            first = torch.where(is_init[:, :1, None], 0, stored)
            stored = F.pad(first.unsqueeze(1), (0, 0, 0, 0, 0, x.shape[1] - 1))
        start = is_init | (torch.arange(x.shape[1], device=x.device) == 0)
        scan: Any = lstm_loop if x.shape[1] == 1 else lstm_scan
        states = scan(steps, self.from_state.weight.to(steps.dtype), start, stored)[0]
        return states[:, :, 0], states


def lstm_loop(
    steps: Tensor, weight: Tensor, start: Tensor, stored: Tensor
) -> tuple[Tensor, Tensor]:
    """The recurrence in plain torch operators: what acting runs, and the oracle of
    :func:`lstm_scan`.

    Args:
        steps: float [B, T, 4 H], what the input adds to i, f, g and o.
        weight: U, [4 H, H].
        start: bool [B, T], where the state is loaded; set at index 0.
        stored: [B, T, 2, H], h and c to load there; not looked at elsewhere.

    Returns:
        (h and c after each step [B, T, 2, H], the gates i, f, g and o [B, T, 4 H]).
    """
    begins = start[..., None, None].unbind(1)
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
    steps: Tensor, weight: Tensor, start: Tensor, stored: Tensor
) -> tuple[Tensor, Tensor]:
    """:func:`lstm_loop` as one operator; gradients flow from the states, not from the gates."""
    return lstm_loop(steps, weight, start, stored)


@torch.library.custom_op("arcade_torch::lstm_scan_backward", mutates_args=())
def lstm_scan_backward(
    weight: Tensor, start: Tensor, stored: Tensor, states: Tensor, gates: Tensor, grad: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of :func:`lstm_scan` with respect to its float arguments, from what it took and
    returned, and the gradient [B, T, 2, H] that arrives at the states.
    """
    begins = start[..., None, None]
    before = torch.where(begins, stored, torch.cat([stored[:, :1], states[:, :-1]], dim=1))
    i, f, g, o = gates.chunk(4, dim=-1)
    squashed = torch.tanh(states[:, :, 1])
    # What does not depend on the gradient from later steps, for all steps at once.
    of_i = g * i * (1 - i)
    of_f = before[:, :, 1] * f * (1 - f)
    of_g = i * (1 - g * g)
    of_o = squashed * o * (1 - o)
    to_gates = torch.cat([of_i, of_f, of_g, of_o], dim=-1).unbind(1)
    to_c = (o * (1 - squashed * squashed)).unbind(1)
    keep = f.unbind(1)
    load = begins.unbind(1)
    grad_of_step = grad.unbind(1)

    grad_steps = torch.empty_like(gates)
    grad_before = torch.empty_like(states)
    carried = torch.zeros_like(states[:, 0])
    for t in range(grad.shape[1] - 1, -1, -1):
        d_h, d_c = (grad_of_step[t] + carried).unbind(1)
        d_c = d_c + d_h * to_c[t]
        d_gates = torch.cat([d_c, d_c, d_c, d_h], dim=-1) * to_gates[t]
        d_before = torch.stack([d_gates @ weight, d_c * keep[t]], dim=1)
        grad_steps[:, t] = d_gates
        grad_before[:, t] = d_before
        carried = d_before.masked_fill(load[t], 0)
    grad_weight = grad_steps.flatten(0, 1).t() @ before[:, :, 0].flatten(0, 1)
    return grad_steps, grad_weight, grad_before.masked_fill(~begins, 0)


@lstm_scan.register_fake
def _(steps: Tensor, weight: Tensor, start: Tensor, stored: Tensor) -> Any:
    return steps.new_empty(stored.shape), steps.new_empty(steps.shape)


@lstm_scan_backward.register_fake
def _(
    weight: Tensor, start: Tensor, stored: Tensor, states: Tensor, gates: Tensor, grad: Tensor
) -> Any:
    return tuple(x.new_empty(x.shape) for x in (gates, weight, stored))


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[1:], *output)


def _differentiate(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
    to_steps, to_weight, to_stored = lstm_scan_backward(*ctx.saved_tensors, grad)
    return to_steps, to_weight, None, to_stored


lstm_scan.register_autograd(_differentiate, setup_context=_save)
lstm_scan.register_vmap(one_by_one(lstm_scan))
lstm_scan_backward.register_vmap(one_by_one(lstm_scan_backward))
