"""Returns and advantages over a window: functions of tensors, and the same as value estimators of
TorchRL.
"""

from contextlib import nullcontext
from numbers import Real
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives.value import TDLambdaEstimator

from arcade_torch.agents.batch_checks import NetworkInputs, is_stock
from arcade_torch.agents.checked import Count, Fraction, coerce, require
from arcade_torch.agents.config import TimeLimit
from arcade_torch.agents.layout import insert_final_observations, unroll
from arcade_torch.envs_jax.validation import format_value, plain


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

    With ``m[t]`` the best value of the observation that step ``t`` really led to, ``done =
    terminated | truncated``, and the end that of the window::

        G[t] = r[t]                                                    at a termination
        G[t] = r[t] + gamma * m[t]                                     at a truncation, at the end
        G[t] = r[t] + gamma * ((1 - lam) * m[t] + lam * G[t + 1])      elsewhere

    Traces are not cut at exploratory actions (Peng's Q(lambda)). The recurrence is solved by
    doubling, in ``ceil(log2(T))`` batched steps, so that no device waits for a Python loop over
    time.

    Args:
        reward: float [B, T], reward received on leaving observation ``t``.
        next_value: float [B, T], ``max_a Q`` of the true next observation: the final frame where an
            episode was cut. Values at terminated steps are ignored, whatever they are.
        terminated: bool [B, T], the task's own end; removes the bootstrap and cuts the recursion.
        truncated: bool [B, T], cut by a limit; keeps the bootstrap, cuts the recursion.
        gamma: discount per step, in [0, 1].
        lam: trace decay in [0, 1]; 0 gives the one-step target, 1 the Monte-Carlo return.
        time_limit: ``"bootstrap"`` or ``"terminal"``; the latter treats a truncation as a
            termination, as the published implementation does.

    Returns:
        float [B, T], in the dtype of ``reward``.

    Raises:
        ValueError: shapes differ or are not [B, T]; integer rewards; ends that are not bool;
            ``gamma``, ``lam`` or ``time_limit`` not as above.

    Source: Peng & Williams (1996); PQN, Gallici et al., arXiv 2407.04811, section 3; POPGym Arcade
        (ICML 2026), PQN.

    Example:
        >>> ones, no = torch.ones(1, 3), torch.zeros(1, 3, dtype=torch.bool)
        >>> q_lambda_return(ones, ones, no, no, gamma=0.5, lam=1.0)
        tensor([[1.8750, 1.7500, 1.5000]])
    """
    value, trace = values_and_traces(
        reward, next_value, terminated, truncated, gamma, lam, time_limit
    )
    return solve_backward(reward + (gamma - trace) * value, trace)


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

    With ``done = terminated | truncated`` and the error ``delta[t] = r[t] + gamma * v'[t] - v[t]``,
    in which the value ``v'[t]`` of the observation that step ``t`` really led to counts as 0 at a
    termination::

        A[t] = delta[t]                                at an end and at the last step
        A[t] = delta[t] + gamma * lam * A[t + 1]       elsewhere

    ``A + v`` is the value target: the lambda-return, where ``v'[t]`` and ``v[t + 1]`` agree.

    Args:
        reward: float [B, T], reward received on leaving observation ``t``.
        value: float [B, T], value of observation ``t``.
        next_value: float [B, T], value of the true next observation.
        terminated: bool [B, T]; this and what follows as in :func:`q_lambda_return`.
        truncated: bool [B, T].
        gamma: discount per step, in [0, 1].
        lam: trace decay in [0, 1]; 0 gives the one-step error, 1 the Monte-Carlo return minus the
            value.
        time_limit: ``"bootstrap"`` or ``"terminal"``.

    Returns:
        float [B, T], in the dtype of ``reward``.

    Raises:
        ValueError: as :func:`q_lambda_return`.

    Source: Schulman et al., arXiv 1506.02438, equation 16.

    Example:
        >>> ones, no = torch.ones(1, 3), torch.zeros(1, 3, dtype=torch.bool)
        >>> gae(ones, ones, ones, no, no, gamma=0.5, lam=1.0)
        tensor([[0.8750, 0.7500, 0.5000]])
    """
    after, trace = values_and_traces(
        reward, next_value, terminated, truncated, gamma, lam, time_limit, value
    )
    return solve_backward(reward + gamma * after - value.to(reward.dtype), trace)


def normalize(advantage: Tensor, mask: Tensor | None = None) -> Tensor:
    """Deviations from the mean, divided by the population deviation; finite where all are equal.

    Where a ``mask`` of the same shape is false nothing counts, and the result is 0.
    """
    if mask is None:
        centred = advantage - advantage.mean()
        return centred / (centred.square().mean().sqrt() + 1e-8)
    count = mask.sum().clamp_min(1)
    mean = advantage.where(mask, 0).sum() / count
    centred = (advantage - mean).where(mask, 0)
    return centred / ((centred.square().sum() / count).sqrt() + 1e-8)


def values_and_traces(
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
    time_limit: TimeLimit,
    *others: Tensor,
) -> tuple[Tensor, Tensor]:
    """What a step may count on, both [B, T]: the next value, 0 behind a termination; gamma times
    lambda, 0 at every end and at the last step. Arguments that do not fit are refused, ``others``
    for their shape alone.
    """
    _check_tensors(reward, next_value, terminated, truncated, *others)
    shapes = {tuple(x.shape) for x in (reward, next_value, terminated, truncated, *others)}
    if len(shapes) != 1 or reward.ndim != 2 or reward.shape[1] == 0:
        raise ValueError(
            "rewards, values, terminated, truncated must be of one shape [B, T], T >= 1; got "
            f"{shapes}"
        )
    if not reward.is_floating_point():  # traces were 0
        raise ValueError(f"the dtype of rewards must be a floating one; got {reward.dtype}")
    if any(x.is_complex() or x.dtype == torch.bool for x in (next_value, *others)):
        kinds = ", ".join(str(x.dtype) for x in (next_value, *others))
        raise ValueError(f"the dtype of values must be a floating one; got {kinds}")
    if terminated.dtype != torch.bool or truncated.dtype != torch.bool:
        kinds = f"{terminated.dtype} and {truncated.dtype}"
        raise ValueError(f"terminated and truncated must be bool; got {kinds}")
    if not (_is_fraction(gamma) and _is_fraction(lam)):
        given = format_value((gamma, lam))
        raise ValueError(f"gamma and lambda must be in [0, 1]; got {given}")
    if time_limit not in ("bootstrap", "terminal"):
        raise ValueError(f"time_limit must be 'bootstrap' or 'terminal'; got {time_limit!r}")
    done = terminated | truncated
    trace = torch.full_like(reward, gamma * lam).masked_fill(done, 0.0)
    trace[:, -1] = 0.0
    no_value = done if time_limit == "terminal" else terminated
    return next_value.to(reward.dtype).masked_fill(no_value, 0.0), trace


def _check_tensors(*values: Any) -> None:
    """Refuse what is no tensor (ValueError)."""
    for x in values:
        if not isinstance(x, Tensor):
            kind = type(x).__name__
            raise ValueError(f"rewards, values and ends must be tensors [B, T]; got a {kind}")


def _is_fraction(value: Any) -> bool:
    """Whether a value is one number in [0, 1]."""
    if isinstance(value, Tensor):
        return value.numel() == 1 and bool((value >= 0.0) & (value <= 1.0))
    is_real = isinstance(value, Real) and not isinstance(value, bool)
    return is_real and 0.0 <= value <= 1.0


def solve_backward(base: Tensor, trace: Tensor) -> Tensor:
    """Solve ``G[t] = base[t] + trace[t] * G[t + 1]`` with ``G[T] = 0`` by doubling."""
    steps = base.shape[1]
    reach = 1
    while reach < steps:
        head = torch.addcmul(base[:, :-reach], trace[:, : steps - reach], base[:, reach:])
        base = torch.cat((head, base[:, -reach:]), dim=1)
        if 2 * reach < steps:
            trace = trace[:, : trace.shape[1] - reach] * trace[:, reach:]
        reach *= 2
    return base


def discount(name: str, value: float | Tensor) -> float:
    """A discount or a decay of traces as a float; refuse one outside [0, 1], or one a step
    (ValueError).
    """
    if isinstance(value, Tensor):
        allowed = "one number for all steps"
        require(value.numel() == 1, name, f"a tensor of shape {list(value.shape)}", allowed)
        value = float(value)
    number: float = coerce(name, value, Fraction)
    return number


class QLambdaEstimator(TDLambdaEstimator):
    """:func:`q_lambda_return` as a value estimator of TorchRL, which a CUDA graph can hold: all its
    shapes are static.

    TorchRL's vectorised TD(lambda) gives the same numbers but splits a batch at its ends, which
    waits for the device.

    Args:
        gamma: discount per step, in [0, 1].
        lmbda: trace decay, in [0, 1].
        value_network: see ``TDLambdaEstimator``; not needed where ``next_value`` is given, as our
            losses do.
        **kwargs: see ``TDLambdaEstimator``.
    """

    def __init__(
        self, *, gamma: float = 0.99, lmbda: float = 0.95, value_network: Any = None, **kwargs: Any
    ) -> None:
        gamma = discount("gamma", gamma)
        lmbda = discount("lmbda", lmbda)
        super().__init__(gamma=gamma, lmbda=lmbda, value_network=value_network, **kwargs)
        self._floats = (gamma, lmbda)

    def value_estimate(
        self,
        tensordict: TensorDictBase,
        target_params: TensorDictBase | None = None,
        next_value: Tensor | None = None,
        time_dim: int | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Lambda-returns, float [B, T, 1], of a batch with ``("next", "reward" | "done" |
        "terminated")`` [B, T, 1].

        The values of the true next observations are ``next_value`` [B, T, 1], or what the value
        network makes of the batch, with ``target_params`` and ``kwargs``. Time is the second
        dimension, whatever ``time_dim``.
        """
        keys = self.tensor_keys
        if next_value is None:
            next_value = self._next_value(tensordict, target_params, kwargs=kwargs)
        after = tensordict["next"]
        returns = q_lambda_return(
            after.get(keys.reward).squeeze(-1),
            next_value.squeeze(-1),
            after.get(keys.terminated).squeeze(-1),
            after.get(keys.done).squeeze(-1),
            *self._floats,
        )
        return returns.unsqueeze(-1)


_READ = ("action", "is_init", "reward", "done", "terminated", "truncated")
"""Entries of a batch that :class:`SequenceGAE` reads, by our names; others may be set."""
_WRITTEN = ("advantage", "value_target")
"""Entries that it writes, beside ``value``."""


class SequenceGAE(nn.Module):
    """Advantages by one pass of the critic over each sequence, final observations read where they
    belong.

    A value estimator for :class:`PPOLoss`: writes ``advantage``, ``value_target``, ``state_value``
    [..., L, 1].

    Args:
        critic: any TensorDict module that writes ``state_value`` [*, 1].
        gamma: discount per step, in [0, 1].
        lmbda: lambda of the estimate, in [0, 1].
        time_limit: ``"bootstrap"``: a truncation keeps the value of its final frame;
            ``"terminal"``: it terminates.
        chunks: parts that the rows are read in, which bounds memory.

    Raises:
        ValueError: an argument out of its range.
        TypeError: the critic is no TensorDict module.
    """

    def __init__(
        self,
        critic: TensorDictModuleBase,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        time_limit: TimeLimit = "bootstrap",
        chunks: int = 1,
    ) -> None:
        super().__init__()
        self.__dict__["critic"] = critic  # its parameters belong to the loss
        self.inputs = NetworkInputs(critic)
        self.time_limit = coerce("time_limit", time_limit, TimeLimit)
        self.gamma = discount("gamma", gamma)
        self.lmbda = discount("lmbda", lmbda)
        self.chunks = coerce("chunks", plain(chunks), Count)
        self.names: dict[str, Any] = {key: key for key in (*_READ, *_WRITTEN)}
        self.names["value"] = "state_value"

    def set_keys(self, **names: Any) -> None:
        """Other names of ``action``, ``is_init``, ``reward``, ``done``, ``terminated``,
        ``truncated``, ``advantage``, ``value_target``, ``value``; the rest is unused.
        """
        self.names |= {name: key for name, key in names.items() if name in self.names}

    @torch.no_grad()
    def forward(
        self, batch: TensorDictBase, params: Any = None, target_params: Any = None
    ) -> TensorDictBase:
        """Estimate advantages; gives the same object, with the three entries.

        Args:
            batch: sequences [N] of ``ArcadeCollector.collect()``, or a stock batch [..., L] with
                next observations.
            params: parameters of the critic; default those it has.
            target_params: not looked at.
        """
        names = {name: self.names[name] for name in _READ}
        data = insert_final_observations(batch, self.inputs, self.time_limit, **names)
        opened: Any = nullcontext()
        if params is not None:
            opened = params.to_module(self.critic, preserve_module_state=False)
        values = []
        with opened:
            for rows in data.chunk(self.chunks):
                values.append(unroll(self.critic, self.inputs, rows, self.names["value"]))
        position = data["position"]
        values_in_time = torch.cat(values)
        extended = data["extended"].shape
        require(
            values_in_time.shape in (extended, (*extended, 1)),
            f"the entry {self.names['value']!r} of the critic",
            f"shape {list(values_in_time.shape[2:])}",
            "one number a step, [*, 1]",
        )
        values_in_time = values_in_time.reshape(extended)

        value = values_in_time.gather(1, position)
        last = values_in_time.shape[1] - 1
        next_value = values_in_time.gather(1, (position + 1).clamp_max(last))
        advantage = gae(
            data["reward"],
            value,
            next_value,
            data["terminated"],
            data["cut"],
            self.gamma,
            self.lmbda,
        )
        entries = {"advantage": advantage, "value_target": advantage + value, "value": value}
        shape = batch.shape if is_stock(batch, names["is_init"]) else advantage.shape
        for key, entry in entries.items():
            batch[self.names[key]] = entry.reshape(shape).unsqueeze(-1)
        return batch
