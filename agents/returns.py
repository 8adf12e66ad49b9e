"""Returns and advantages as functions of plain tensors, and as value estimators of TorchRL."""

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives.value import TDLambdaEstimator

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
    _check((reward, next_value, terminated, truncated), gamma, lam, time_limit)
    value, trace = _bootstrap(reward, next_value, terminated, truncated, gamma * lam, time_limit)
    base = reward + (gamma - trace) * value
    return _solve_backward(base, trace)


def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
    time_limit: TimeLimit = "bootstrap",
) -> Tensor:
    r"""Generalised advantage estimate over a window.

    With ``done = terminated | truncated`` and the error ``delta[t] = r[t] + gamma * v'[t] - v[t]``, in which the value
    ``v'[t]`` of the observation that step ``t`` really led to counts as 0 at a termination::

        A[t] = delta[t]                                at an end and at the last step
        A[t] = delta[t] + gamma * lam * A[t + 1]       elsewhere

    ``A + v`` is the value target: the lambda-return, where ``v'[t]`` and ``v[t + 1]`` agree.

    Args:
        reward: float [B, T], reward received on leaving observation ``t``.
        value: float [B, T], value of observation ``t``.
        next_value: float [B, T], value of the true next observation: the final frame where an episode was cut. Values
            at terminated steps are ignored, whatever they are.
        terminated: bool [B, T], the task's own end; removes the bootstrap and cuts the recursion.
        truncated: bool [B, T], cut by a limit; keeps the bootstrap, cuts the recursion.
        gamma: discount per step, in [0, 1].
        lam: trace decay in [0, 1]; 0 gives the one-step error, 1 the Monte-Carlo return minus the value.
        time_limit: ``"bootstrap"`` or ``"terminal"``; the latter treats a truncation as a termination, as the published
            implementation does.

    Returns:
        float [B, T], in the dtype of ``reward``.

    Raises:
        ValueError: shapes differ or are not [B, T], ``gamma`` or ``lam`` lie outside [0, 1], ``time_limit`` is unknown.

    Source: Schulman et al., arXiv 1506.02438, equation 16.

    Example:
        >>> ones, no = torch.ones(1, 3), torch.zeros(1, 3, dtype=torch.bool)
        >>> gae(ones, ones, ones, no, no, gamma=0.5, lam=1.0)
        tensor([[0.8750, 0.7500, 0.5000]])
    """
    _check((reward, value, next_value, terminated, truncated), gamma, lam, time_limit)
    after, trace = _bootstrap(reward, next_value, terminated, truncated, gamma * lam, time_limit)
    return _solve_backward(reward + gamma * after - value, trace)


def _bootstrap(
    reward: Tensor, next_value: Tensor, terminated: Tensor, truncated: Tensor, decay: float, time_limit: TimeLimit
) -> tuple[Tensor, Tensor]:
    """What a step may count on: the next value, 0 behind an end, and the trace, 0 at every end and at the last step."""
    done = terminated | truncated
    trace = torch.full_like(reward, decay).masked_fill(done, 0.0)
    trace[:, -1] = 0.0
    return next_value.masked_fill(done if time_limit == "terminal" else terminated, 0.0), trace


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


def _check(parts: tuple[Tensor, ...], gamma: float, lam: float, time_limit: str) -> None:
    shapes = {tuple(x.shape) for x in parts}
    if len(shapes) != 1 or parts[0].ndim != 2 or parts[0].shape[1] == 0:
        raise ValueError(f"rewards, values, terminated, truncated must share one shape [B, T], T >= 1; got {shapes}")
    if not 0.0 <= gamma <= 1.0 or not 0.0 <= lam <= 1.0:
        raise ValueError(f"gamma and lambda must lie in [0, 1]; got gamma={gamma}, lambda={lam}")
    if time_limit not in ("bootstrap", "terminal"):
        raise ValueError(f"time_limit must be 'bootstrap' or 'terminal'; got {time_limit!r}")


class QLambdaEstimator(TDLambdaEstimator):
    """:func:`q_lambda_return` as a value estimator of TorchRL; needs no data-dependent shape, so a CUDA graph can hold
    it.

    TorchRL's vectorised TD(lambda) gives the same numbers but splits a batch at its ends, which waits for the device.

    Args:
        gamma: discount per step, in [0, 1].
        lmbda: trace decay, in [0, 1].
        value_network: see ``TDLambdaEstimator``; not needed where ``next_value`` is given, as our losses do.
        **kwargs: see ``TDLambdaEstimator``.
    """

    def __init__(self, *, gamma: float = 0.99, lmbda: float = 0.95, value_network: Any = None, **kwargs: Any) -> None:
        super().__init__(gamma=gamma, lmbda=lmbda, value_network=value_network, **kwargs)
        self._floats = float(gamma), float(lmbda)

    def value_estimate(
        self,
        tensordict: TensorDictBase,
        target_params: TensorDictBase | None = None,
        next_value: Tensor | None = None,
        time_dim: int | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Lambda-returns of a batch [B, T].

        Args:
            tensordict: with ``("next", "reward" | "done" | "terminated")`` [B, T, 1].
            target_params: parameters of the value network, if it is to give the next values.
            next_value: float [B, T, 1], values of the true next observations.
            time_dim: ignored, time is the second dimension.
            **kwargs: handed to the value network.

        Returns:
            float [B, T, 1].
        """
        keys = self.tensor_keys
        if next_value is None:
            next_value = self._next_value(tensordict, target_params, kwargs=kwargs)
        reward, done, terminated = (
            tensordict.get(("next", key)).squeeze(-1) for key in (keys.reward, keys.done, keys.terminated)
        )
        value = next_value.squeeze(-1)
        return self.returns(reward, value, terminated, done & ~terminated).unsqueeze(-1)

    def returns(self, reward: Tensor, next_value: Tensor, terminated: Tensor, truncated: Tensor) -> Tensor:
        """:func:`q_lambda_return` with the numbers of this estimator; everything [B, T]."""
        return q_lambda_return(reward, next_value, terminated, truncated, *self._floats)
