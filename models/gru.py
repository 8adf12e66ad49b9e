"""Gated recurrent unit, the paper's variant (not torch's)."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.memory import Memory

__all__ = ["GRU", "gru_loop", "gru_scan", "gru_scan_backward", "one_by_one"]


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
        steps = self.from_input(x)
        if h0.ndim < x.ndim:  # every start but index 0 loads zeros
            first = torch.where(is_init[:, :1], 0, h0)
            stored = F.pad(first.unsqueeze(1), (0, 0, 0, x.shape[1] - 1))
        else:
            stored = h0
        start = is_init | (torch.arange(x.shape[1], device=x.device) == 0)
        scan: Any = gru_loop if x.shape[1] == 1 else gru_scan
        weights = self.gates_from_state.weight, self.candidate_from_state.weight
        y = scan(
            steps, *(weight.to(steps.dtype) for weight in weights), start, stored.to(steps.dtype)
        )[0]
        return y, y


def gru_loop(
    steps: Tensor, gates_weight: Tensor, candidate_weight: Tensor, start: Tensor, stored: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The recurrence in plain torch operators: what acting runs, and the oracle of
    :func:`gru_scan`.

    Args:
        steps: float [B, T, 3 H], what the input adds to z, r and c.
        gates_weight: U, [2 H, H].
        candidate_weight: U_h, [H, H].
        start: bool [B, T], where the state is loaded; set at index 0.
        stored: [B, T, H], the state to load there; not looked at elsewhere.

    Returns:
        (the state after each step [B, T, H], z and r [B, T, 2 H], c [B, T, H]).
    """
    size = candidate_weight.shape[0]
    to_gates, to_candidate = steps.split([2 * size, size], dim=-1)
    to_gates_of_step = to_gates.unbind(1)
    to_candidate_of_step = to_candidate.unbind(1)
    begins = start.unsqueeze(-1).unbind(1)
    fresh = stored.unbind(1)

    states = []
    gates = []
    candidates = []
    h = stored[:, 0]
    for t in range(steps.shape[1]):
        if t > 0:
            h = torch.where(begins[t], fresh[t], h)
        z_and_r = torch.sigmoid(torch.addmm(to_gates_of_step[t], h, gates_weight.t()))
        z, r = z_and_r.chunk(2, dim=-1)
        c = torch.tanh(torch.addmm(to_candidate_of_step[t], r * h, candidate_weight.t()))
        h = torch.lerp(h, c, z)
        states.append(h)
        gates.append(z_and_r)
        candidates.append(c)
    return torch.stack(states, dim=1), torch.stack(gates, dim=1), torch.stack(candidates, dim=1)


@torch.library.custom_op("arcade_torch::gru_scan", mutates_args=())
def gru_scan(
    steps: Tensor, gates_weight: Tensor, candidate_weight: Tensor, start: Tensor, stored: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`gru_loop` as one operator; gradients flow from the states, not from the gates and
    candidates.
    """
    return gru_loop(steps, gates_weight, candidate_weight, start, stored)


@torch.library.custom_op("arcade_torch::gru_scan_backward", mutates_args=())
def gru_scan_backward(
    gates_weight: Tensor,
    candidate_weight: Tensor,
    start: Tensor,
    stored: Tensor,
    states: Tensor,
    gates: Tensor,
    candidates: Tensor,
    grad: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of :func:`gru_scan` with respect to its float arguments, from what it took and
    returned, and the gradient [B, T, H] that arrives at the states.
    """
    size = candidate_weight.shape[0]
    begins = start.unsqueeze(-1)
    before = torch.where(begins, stored, torch.cat([stored[:, :1], states[:, :-1]], dim=1))
    z, r = gates.chunk(2, dim=-1)
    # What does not depend on the gradient from later steps, for all steps at once.
    to_c = z * (1 - candidates * candidates)
    to_gates = gates * (1 - gates)
    to_gates[..., :size] *= candidates - before
    to_gates[..., size:] *= before
    columns = [x.unbind(1) for x in (to_c, to_gates, 1 - z, r, begins, grad)]
    by_step = list(zip(*columns, strict=True))
    grad_steps = grad.new_empty(*grad.shape[:2], 3 * size)
    grad_before = torch.empty_like(states)
    carried = torch.zeros_like(states[:, 0])
    for t in range(grad.shape[1] - 1, -1, -1):
        to_c_t, to_gates_t, keep, r_t, begins_t, grad_t = by_step[t]
        d_h = grad_t + carried
        d_c = d_h * to_c_t
        d_reset = d_c @ candidate_weight
        d_gates = torch.cat([d_h, d_reset], dim=-1) * to_gates_t
        d_before = torch.addmm(d_h * keep + d_reset * r_t, d_gates, gates_weight)
        grad_steps[:, t, : 2 * size] = d_gates
        grad_steps[:, t, 2 * size :] = d_c
        grad_before[:, t] = d_before
        carried = d_before.masked_fill(begins_t, 0)
    d_gates, d_c = grad_steps.split([2 * size, size], dim=-1)
    grad_gates_weight = d_gates.flatten(0, 1).t() @ before.flatten(0, 1)
    grad_candidate_weight = d_c.flatten(0, 1).t() @ (r * before).flatten(0, 1)
    grad_stored = grad_before.masked_fill(~begins, 0)
    return grad_steps, grad_gates_weight, grad_candidate_weight, grad_stored


@gru_scan.register_fake
def _(
    steps: Tensor, gates_weight: Tensor, candidate_weight: Tensor, start: Tensor, stored: Tensor
) -> Any:
    batch, length, size = stored.shape
    return tuple(steps.new_empty(batch, length, width) for width in (size, 2 * size, size))


@gru_scan_backward.register_fake
def _(
    gates_weight: Tensor, candidate_weight: Tensor, start: Tensor, stored: Tensor, *rest: Tensor
) -> Any:
    grad_steps = stored.new_empty(*stored.shape[:2], 3 * stored.shape[2])
    return grad_steps, *(x.new_empty(x.shape) for x in (gates_weight, candidate_weight, stored))


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[1:], *output)


def _differentiate(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
    to_steps, to_gates, to_candidate, to_stored = gru_scan_backward(*ctx.saved_tensors, grad)
    return to_steps, to_gates, to_candidate, None, to_stored


gru_scan.register_autograd(_differentiate, setup_context=_save)


def one_by_one(op: Any) -> Any:
    """A vmap rule: the operator once for each entry of the mapped dimension (the weights may
    differ).
    """

    def rule(info: Any, in_dims: tuple[int | None, ...], *args: Tensor) -> Any:
        rows = [
            [x] * info.batch_size if d is None else x.unbind(d)
            for x, d in zip(args, in_dims, strict=True)
        ]
        results = [op(*row) for row in zip(*rows, strict=True)]
        return tuple(torch.stack(parts) for parts in zip(*results, strict=True)), (0,) * len(
            results[0]
        )

    return rule


gru_scan.register_vmap(one_by_one(gru_scan))
gru_scan_backward.register_vmap(one_by_one(gru_scan_backward))
