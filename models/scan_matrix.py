"""The matrix-valued linear recurrence: what linear attention, the delta rule and its gated form do
over time.

    S_t = alpha_t (I - beta_t k_t k_t^T) S_{t-1} + k_t v_t^T,    o_t = S_t^T q_t,    S [K, V]

:func:`matrix_scan` is the function to use. :func:`matrix_scan_loop` beside it is the same thing as
a loop that can be read at a glance, and the oracle of the tests. :func:`matrix_scan_stored` begins
in states that a replay buffer kept.

The fast form cuts time into chunks. Within one, every matrix is gone: S_t = sum_j (decay from j to
t) k_j u_j^T, where the rows u solve one unit lower triangular system (without erasing, u = v), so a
chunk is a few small matrix products, and only one state per chunk is ever made. Plain torch
operators: autograd, vmap and torch.compile need no help.

Source: Yang et al. (2024), arXiv 2406.06484, section 3.2; with decay: Yang et al. (2025), arXiv
2412.06464, section 3.3.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from arcade_torch.models.arguments import is_whole
from arcade_torch.models.scan import linear_scan

__all__ = ["MatrixSteps", "matrix_scan", "matrix_scan_loop", "matrix_scan_stored"]

CHUNK = 32  # steps; the fastest on a CPU for K = V = 23


class MatrixSteps(NamedTuple):
    """What every step does to the matrix."""

    query: Tensor
    """[B, T, K]: read out o = S^T q, after writing"""
    key: Tensor
    """[B, T, K]: where to write"""
    value: Tensor
    """[B, T, V]: what to write, times the strength of writing"""
    erase: Tensor | None = None
    """[B, T, 1]: beta, how much of what is stored under the key goes first; None erases nothing"""
    log_decay: Tensor | None = None
    """[B, T, 1]: log alpha, at most 0; None keeps everything"""


def matrix_scan(
    steps: MatrixSteps, start: Tensor, h0: Tensor, *, chunk: int = CHUNK
) -> tuple[Tensor, Tensor]:
    """Run the recurrence over a sequence, starting afresh (from zeros) wherever ``start`` is set.

    Nothing crosses a start, be it a NaN or infinity; one in what is written (or in ``h0``) loses
    the rest of its episode, whose outputs and states become NaN.

    Args:
        steps: what each step does.
        start: bool [B, T].
        h0: [B, K, V], the state before index 0; not looked at where ``start[:, 0]``.
        chunk: largest number of steps in a chunk. Memory is O(T chunk + T / chunk K V), never T K
            V.

    Returns:
        (o [B, T, V], the last state [B, K, V]).

    Raises:
        ValueError: shapes or dtypes do not fit, ``start`` is not bool [B, T], or ``chunk`` is no
            whole number from 1.
    """
    check_steps(steps, start, h0)
    if not is_whole(chunk) or chunk < 1:
        raise ValueError(f"chunk must be a whole number from 1, got {chunk!r}")
    if steps.query.shape[1] == 1:  # acting
        state = torch.where(start[:, 0, None, None], 0, h0)
        out, state = _step([None if x is None else x[:, 0] for x in steps], state)
        return out.unsqueeze(1), state
    out, _, last = _chunked(steps, start, h0, chunk)
    return out, last


def matrix_scan_loop(
    steps: MatrixSteps, start: Tensor, h0: Tensor, *, erase_values: bool = False
) -> tuple[Tensor, Tensor]:
    """The same recurrence step by step (slow).

    Args:
        steps: what each step does.
        start: bool [B, T].
        h0: [B, K, V], the state before index 0; or [B, T, K, V], a state per position, loaded at
            index 0 and wherever ``start`` is set.
        erase_values: erase from the other side, S_t = alpha S_{t-1} (I - beta k k^T) + k v^T, which
            needs K = V: the transition of the reference package's gated delta net, which does not
            do what the delta rule is for.

    Returns:
        (o [B, T, V], the state after each step [B, T, K, V]).

    Raises:
        ValueError: shapes or dtypes do not fit, ``start`` is not bool [B, T], or ``erase_values``
            with K other than V.
    """
    check_steps(steps, start, h0, takes_stored=True)
    if erase_values and steps.key.shape[-1] != steps.value.shape[-1]:
        sizes = f"{steps.key.shape[-1]} and {steps.value.shape[-1]}"
        raise ValueError(f"erase_values needs K = V, got {sizes}")
    stored = h0.ndim == steps.query.ndim + 1
    state = h0[:, 0] if stored else h0
    outputs = []
    states = []
    for t, begins in enumerate(start[..., None, None].unbind(1)):
        if stored and t > 0:
            state = torch.where(begins, h0[:, t], state)
        elif not stored:
            state = torch.where(begins, 0, state)
        out, state = _step([None if x is None else x[:, t] for x in steps], state, erase_values)
        outputs.append(out)
        states.append(state)
    return torch.stack(outputs, dim=1), torch.stack(states, dim=1)


def check_steps(steps: MatrixSteps, start: Any, h0: Any, *, takes_stored: bool = False) -> None:
    """Raise ValueError unless shapes and dtypes are those that :func:`matrix_scan` documents.

    Args:
        steps: what each step does.
        start: bool [B, T].
        h0: [B, K, V].
        takes_stored: whether it may be [B, T, K, V] too.
    """
    query, _, value = steps[:3]
    if query.ndim != 3 or value.ndim != 3 or query.shape[1] == 0:
        raise ValueError(
            "query must be [B, T, K] and value [B, T, V] with at least one step, got "
            f"{list(query.shape)} and {list(value.shape)}"
        )
    lead = list(query.shape[:2])
    size = query.shape[-1]
    widths = {"query": size, "key": size, "value": value.shape[-1], "erase": 1, "log_decay": 1}
    for name, x in steps._asdict().items():
        if x is not None and list(x.shape) != [*lead, widths[name]]:
            raise ValueError(f"{name} must be {[*lead, widths[name]]}, got {list(x.shape)}")
        if x is not None and x.dtype != query.dtype:
            raise ValueError(f"{name} is {x.dtype}, and query {query.dtype}: cast one of them")
    if not isinstance(start, Tensor) or start.dtype != torch.bool or list(start.shape) != lead:
        got = f"{start.dtype} {list(start.shape)}" if isinstance(start, Tensor) else repr(start)
        raise ValueError(f"start must be bool {lead}, got {got}; [B, T, 1] needs squeeze(-1)")
    matrix = [size, value.shape[-1]]
    allowed = [[lead[0], *matrix], [*lead, *matrix]] if takes_stored else [[lead[0], *matrix]]
    if not isinstance(h0, Tensor) or list(h0.shape) not in allowed:
        got = str(list(h0.shape)) if isinstance(h0, Tensor) else repr(h0)
        raise ValueError(f"h0 must be {' or '.join(map(str, allowed))}, got {got}")
    if h0.dtype != query.dtype:
        raise ValueError(f"h0 is {h0.dtype}, and query {query.dtype}: cast one of them")


def matrix_scan_stored(steps: MatrixSteps, start: Tensor, stored: Tensor) -> tuple[Tensor, Tensor]:
    """Run the recurrence from stored states, one per position, and return the state after each
    step.

    What was loaded only fades, S_t = c_t G + D_t with G the loaded state and c_t the decay since
    then; D begins with zeros and follows the same recurrence, for values less what G holds under
    the key.

    Args:
        steps: what each step does.
        start: bool [B, T].
        stored: [B, T, K, V], loaded at index 0 and wherever ``start`` is set, not looked at
            elsewhere.

    Returns:
        (o [B, T, V], the state after each step [B, T, K, V]).
    """
    index = torch.arange(start.shape[1], device=start.device)
    begins = start | (index == 0)
    alpha = stored.new_ones(()) if steps.log_decay is None else steps.log_decay.exp()
    if steps.erase is not None:
        loaded_at = torch.where(begins, index, 0).cummax(dim=1).values
        loaded = torch.take_along_dim(stored, loaded_at[..., None, None], dim=1)
        faded = torch.einsum("btk,btkv->btv", steps.key, loaded)
        if steps.log_decay is not None:
            ones = torch.ones_like(steps.log_decay)
            faded = linear_scan(alpha, torch.zeros_like(ones), begins, ones) * faded
        steps = steps._replace(value=steps.value - steps.erase * faded)
    _, written, _ = _chunked(steps, begins, torch.zeros_like(stored[:, 0]), CHUNK)
    writes = steps.key.unsqueeze(-1) * written.unsqueeze(-2)
    states = linear_scan(alpha if alpha.ndim == 0 else alpha.unsqueeze(-1), writes, begins, stored)
    return torch.einsum("btk,btkv->btv", steps.query, states), states


def _step(
    step: list[Tensor | None], state: Tensor, erase_values: bool = False
) -> tuple[Tensor, Tensor]:
    """One step, everything without the time dimension: (o [B, V], S_t)."""
    query, key, value, erase, log_decay = step
    assert query is not None and key is not None and value is not None
    if log_decay is not None:
        state = log_decay.exp().unsqueeze(-1) * state
    if erase is not None and erase_values:
        recalled = torch.bmm(state, key.unsqueeze(-1))
        state = torch.baddbmm(state, erase.unsqueeze(-1) * recalled, key.unsqueeze(1), alpha=-1)
    elif erase is not None:
        value = value - erase * torch.bmm(key.unsqueeze(1), state).squeeze(1)
    state = torch.baddbmm(state, key.unsqueeze(-1), value.unsqueeze(1))
    return torch.bmm(query.unsqueeze(1), state).squeeze(1), state


def _chunked(
    steps: MatrixSteps, start: Tensor, h0: Tensor, chunk: int
) -> tuple[Tensor, Tensor, Tensor]:
    """(o [B, T, V], the rows u [B, T, V] that were written, the last state [B, K, V])."""
    length = start.shape[1]
    steps, h0, lost = _contained(steps, start, h0)
    count = math.ceil(length / chunk)
    size = math.ceil(length / count)
    spare = count * size - length  # steps that write, erase and forget nothing

    def in_chunks(x: Tensor) -> Tensor:
        """[B, T, ...] as [B, count, size, ...]."""
        padded: Tensor = F.pad(x, (0, 0, 0, spare))
        return padded.unflatten(1, (count, size))  # type: ignore[no-any-return]

    query = in_chunks(steps.query)
    key = in_chunks(steps.key)
    value = in_chunks(steps.value)
    erase = None if steps.erase is None else in_chunks(steps.erase)
    log_decay = None if steps.log_decay is None else in_chunks(steps.log_decay)
    # 0: runs when the chunk begins
    episode = F.pad(start, (0, spare)).unflatten(1, (count, size)).cumsum(-1)
    decay, fade = _decays(episode, log_decay, query.dtype)
    attention = (query @ key.mT) * decay
    erased = None
    if erase is not None:
        system = (key @ key.mT) * decay * erase
        given = torch.cat([value, key * (fade * erase)], dim=-1)
        exact = torch.promote_types(given.dtype, torch.float32)  # no solver knows half precision
        solved = torch.linalg.solve_triangular(
            system.tril(-1).to(exact), given.to(exact), upper=False, unitriangular=True
        ).to(given.dtype)
        value, erased = solved.split([value.shape[-1], key.shape[-1]], dim=-1)
    state = torch.where(start[:, 0, None, None], 0, h0)
    befores = []
    written = []
    rows = zip(
        (key * decay[..., -1, :].unsqueeze(-1)).mT.unbind(1),
        value.unbind(1),
        fade[..., -1:, :].unbind(1),
        [None] * count if erased is None else erased.unbind(1),
        strict=True,
    )
    for keys, u, left, gone in rows:
        befores.append(state)
        u = u if gone is None else torch.baddbmm(u, gone, state, alpha=-1)
        written.append(u)
        state = torch.baddbmm(left * state, keys, u)
    u = torch.stack(written, dim=1)
    out = attention @ u + (query * fade) @ torch.stack(befores, dim=1)
    out = out.flatten(1, 2)[:, :length].masked_fill(lost, torch.nan)
    u = u.flatten(1, 2)[:, :length].masked_fill(lost, torch.nan)
    return out, u, state.masked_fill(lost[:, -1:], torch.nan)


def _contained(steps: MatrixSteps, start: Tensor, h0: Tensor) -> tuple[MatrixSteps, Tensor, Tensor]:
    """Zeros for what is not finite, which a product with zero would not stop, and which steps have
    lost their state.

    Queries stay: each has a part in its own output alone.

    Returns:
        (steps, h0, bool [B, T, 1]: something since the episode began was not finite).
    """
    _, key, value, erase, log_decay = steps
    total = key.sum(-1) + value.sum(-1)
    if erase is not None:
        total = total + erase.squeeze(-1)
    if log_decay is not None:
        total = total + log_decay.exp().squeeze(-1)
    bad = ~total.isfinite()
    bad_h0 = ~h0.sum((-1, -2)).isfinite()
    index = torch.arange(start.shape[1], device=start.device)
    last_bad = torch.where(bad, index, -1 - (~bad_h0).long().unsqueeze(-1)).cummax(dim=1).values
    lost = last_bad >= torch.where(start, index, -1).cummax(dim=1).values
    bad = bad.unsqueeze(-1)
    key = key.masked_fill(bad, 0)
    value = value.masked_fill(bad, 0)
    if erase is not None:
        erase = erase.masked_fill(bad, 0)
    if log_decay is not None:
        log_decay = log_decay.masked_fill(bad, 0)
    h0 = h0.masked_fill(bad_h0[:, None, None], 0)
    return MatrixSteps(steps.query, key, value, erase, log_decay), h0, lost.unsqueeze(-1)


def _decays(episode: Tensor, log_decay: Tensor | None, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """How much of what step j wrote is there at step i, and how much of what was there when the
    chunk began.

    Every ratio is summed in log space over its own steps alone, so none exceeds 1 and nothing
    before a start, nor the rounding of it, has a part in what comes after.

    Args:
        episode: int64 [B, N, C], number of starts in the chunk up to each step.
        log_decay: [B, N, C, 1] or None.
        dtype: of the result.

    Returns:
        (decay [B, N, C, C], zero for j > i and over a start; fade [B, N, C, 1], zero from the first
        start on).
    """
    size = episode.shape[-1]
    past = torch.ones(size, size, dtype=torch.bool, device=episode.device).tril()
    seen = (episode.unsqueeze(-1) == episode.unsqueeze(-2)) & past
    open_ = (episode == 0).unsqueeze(-1)
    if log_decay is None:
        return seen.to(dtype), open_.to(dtype)
    between = torch.where(past.tril(-1), log_decay, 0).cumsum(dim=-2)
    return torch.where(seen, between.exp(), 0), torch.where(open_, log_decay.cumsum(-2).exp(), 0)
