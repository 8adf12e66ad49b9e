"""The lambda-return of Q-learning: one pure function, no network, no environment."""

from typing import Literal

import torch
from torch import Tensor

TimeLimit = Literal["bootstrap", "terminal"]


def q_lambda_return(
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
    time_limit: TimeLimit = "bootstrap",
) -> Tensor:
    r"""Backward Q(lambda) return over a window.

    With ``m[t]`` the best value of the observation that step ``t`` really led to, ``done = terminated | truncated``::

        G[t] = r[t] + gamma * m[t]                                          at a truncation and at the last step
        G[t] = r[t]                                                         at a termination
        G[t] = r[t] + gamma * ((1 - lam) * m[t] + lam * G[t + 1])           elsewhere

    Traces are not cut at exploratory actions (Peng's Q(lambda)). The recurrence is solved by doubling, in
    ``ceil(log2(T))`` batched steps, so that no device waits for a Python loop over time.

    Args:
        reward: float [B, T], reward received on leaving observation ``t``.
        next_value: float [B, T], ``max_a Q`` of the true next observation: the final frame where an episode was cut.
            Values at terminated steps are ignored, whatever they are.
        terminated: bool [B, T], the task's own end; removes the bootstrap and cuts the recursion.
        truncated: bool [B, T], cut by a limit; keeps the bootstrap, cuts the recursion.
        gamma: discount per step, in [0, 1].
        lam: trace decay in [0, 1]; 0 gives the one-step target, 1 the Monte-Carlo return.
        time_limit: ``"bootstrap"`` or ``"terminal"``; the latter treats a truncation as a termination, as the published
            implementation does.

    Returns:
        float [B, T], in the dtype of ``reward``.

    Raises:
        ValueError: shapes differ or are not [B, T], ``gamma`` or ``lam`` lie outside [0, 1], ``time_limit`` is unknown.

    Source: Peng & Williams (1996); PQN, Gallici et al., arXiv 2407.04811, section 3; POPGym Arcade (ICML 2026), PQN.

    Example:
        >>> ones, no = torch.ones(1, 3), torch.zeros(1, 3, dtype=torch.bool)
        >>> q_lambda_return(ones, ones, no, no, gamma=0.5, lam=1.0)
        tensor([[1.8750, 1.7500, 1.5000]])
    """
    _check(reward, next_value, terminated, truncated, gamma, lam, time_limit)
    done = terminated | truncated
    if time_limit == "terminal":
        terminated = done
    trace = torch.where(done, 0.0, gamma * lam).to(reward.dtype)
    trace[:, -1] = 0.0
    value = torch.where(terminated, 0.0, next_value)
    base = reward + (gamma - trace) * value
    return _solve_backward(base, trace)


def _solve_backward(base: Tensor, trace: Tensor) -> Tensor:
    """Solve ``G[t] = base[t] + trace[t] * G[t + 1]`` with ``G[T] = 0`` by doubling."""
    steps, reach = base.shape[1], 1
    while reach < steps:
        head = torch.addcmul(base[:, :-reach], trace[:, : steps - reach], base[:, reach:])
        base = torch.cat((head, base[:, -reach:]), dim=1)
        if 2 * reach < steps:
            trace = trace[:, : trace.shape[1] - reach] * trace[:, reach:]
        reach *= 2
    return base


def _check(
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
    time_limit: str,
) -> None:
    shapes = {tuple(x.shape) for x in (reward, next_value, terminated, truncated)}
    if len(shapes) != 1 or reward.ndim != 2 or reward.shape[1] == 0:
        raise ValueError(f"reward, next_value, terminated, truncated must share one shape [B, T], T >= 1; got {shapes}")
    if not 0.0 <= gamma <= 1.0 or not 0.0 <= lam <= 1.0:
        raise ValueError(f"gamma and lambda must lie in [0, 1]; got gamma={gamma}, lambda={lam}")
    if time_limit not in ("bootstrap", "terminal"):
        raise ValueError(f"time_limit must be 'bootstrap' or 'terminal'; got {time_limit!r}")
