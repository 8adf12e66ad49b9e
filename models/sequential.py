"""What recurrences that go step by step share: where they load a state, how their tensors lie in
memory, and how ``vmap`` runs a loop that is one operator.
"""

from typing import Any

import torch
from torch import Tensor

__all__ = [
    "Loads",
    "in_time_order",
    "later_starts",
    "linear_backward",
    "one_by_one",
    "start_and_stored",
    "time_first",
]


def start_and_stored(
    h0: Tensor, is_init: Tensor, state_ndim: int, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Where a sequence loads a state, and what it loads.

    Args:
        h0: as in ``Memory.run``: [B, \\*S], the state before index 0, or [B, T, \\*S], one for each
            step.
        is_init: bool [B, T].
        state_ndim: dimensions of one state, without the batch: the length of S.
        dtype: of the recurrence.

    Returns:
        (start bool [B, T], ``is_init`` and index 0; stored [B, T, \\*S], or [B, 1, \\*S] where
        every start but index 0 loads zeros).
    """
    start = is_init | (torch.arange(is_init.shape[1], device=is_init.device) == 0)
    stored = h0.to(dtype)
    if h0.ndim == 1 + state_ndim:
        begins = is_init[:, 0].reshape(-1, *(1,) * state_ndim)
        stored = torch.where(begins, 0, stored).unsqueeze(1)
    return start, stored


def later_starts(is_init: Tensor) -> list[int]:
    """Steps behind the first at which an episode of the batch begins; all where flags have no
    values to read (``vmap``).
    """
    try:
        return (is_init[:, 1:].any(dim=0).nonzero().flatten() + 1).tolist()
    except RuntimeError:
        return list(range(1, is_init.shape[1]))


class Loads:
    """The places of a batch of sequences at which a recurrence loads a state instead of going on.

    Args:
        start: bool [B, T], set at index 0.
        stored: [B, T, \\*S], the state to load there, not looked at elsewhere; or [B, 1, \\*S]: the
            one of index 0, and zeros at later starts.
    """

    def __init__(self, start: Tensor, stored: Tensor) -> None:
        self.start = start
        self.stored = stored
        self.first = stored[:, 0]
        # nobody waits for an answer of a card: there every step may be a start
        some = start.any(0).tolist() if start.device.type == "cpu" else None
        self.masks: dict[int, Tensor] = {}
        for t in range(1, start.shape[1]):
            if some is None or some[t]:
                self.masks[t] = start[:, t].reshape(-1, *(1,) * (self.first.ndim - 1))

    def apply(self, t: int, state: Tensor) -> Tensor:
        """The state that step t reads, from the one after step t - 1."""
        if t not in self.masks:
            return state
        return torch.where(self.masks[t], self._of(t), state)

    def before(self, states: Tensor) -> Tensor:
        """The state that every step reads [B, T, \\*S], from those after every step; in memory it
        lies as in :func:`time_first`.
        """
        first = self.stored[:, :1].transpose(0, 1)
        before = torch.cat([first, states[:, :-1].transpose(0, 1)]).transpose(0, 1)
        for t, mask in self.masks.items():
            before[:, t] = torch.where(mask, self._of(t), before[:, t])
        return before

    def collect(self, t: int, carried: Tensor, grad_stored: Tensor) -> None:
        """Hand over the gradient of the state that step t reads: what was loaded keeps it, and
        ``carried`` then goes on, in place, with zeros there.
        """
        if t == 0:
            grad_stored[:, 0] = carried
        elif t in self.masks:
            if self.stored.shape[1] > 1:
                grad_stored[:, t] = torch.where(self.masks[t], carried, 0)
            carried.masked_fill_(self.masks[t], 0)

    def _of(self, t: int) -> Tensor:
        """What step t loads."""
        return self.stored[:, t] if self.stored.shape[1] > 1 else self.stored.new_zeros(())


def time_first(source: Tensor, *shape: int) -> Tensor:
    """An empty tensor [B, T, *shape] with B, T, dtype and device of another one [B, T, ...].

    Its steps lie one after the other in memory, so that a loop over time reads and writes each in
    one piece: 64 rows that lie T steps apart share few places of a processor's cache.
    """
    batch, steps = source.shape[:2]
    return source.new_empty(steps, batch, *shape).transpose(0, 1)


def in_time_order(x: Tensor) -> Tensor:
    """The rows [T B, \\*S] of a tensor [B, T, \\*S], a view if it lies as in
    :func:`time_first`.
    """
    batch, steps, *shape = x.shape
    return x.transpose(0, 1).reshape(steps * batch, *shape)  # batched gradients know no flatten


def linear_backward(
    x: Tensor, weight: Tensor, grad: Tensor, needs_x: bool
) -> tuple[Tensor | None, Tensor, Tensor]:
    """Gradients of W x + b with respect to x [B, T, D] (None unless wanted), W and b, from the one
    of its output [B, T, F], which lies as in :func:`time_first`.
    """
    rows = in_time_order(grad)
    d_x = None
    if needs_x:
        batch, steps = grad.shape[:2]
        d_x = (rows @ weight).reshape(steps, batch, weight.shape[1]).transpose(0, 1)
    return d_x, rows.t() @ in_time_order(x), rows.sum(0)


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
        if isinstance(results[0], Tensor):
            return torch.stack(results), 0
        stacked = tuple(torch.stack(parts) for parts in zip(*results, strict=True))
        return stacked, (0,) * len(stacked)

    return rule
