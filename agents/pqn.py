"""PQN: Q-learning with lambda-returns, no replay buffer, no target network; with memory or
without.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator
from torchrl.objectives.value import ValueEstimatorBase

from arcade_torch.agents.batch_checks import Key, NetworkInputs, is_prepared, is_stock, with_mask
from arcade_torch.agents.checked import CountOrZero, coerce, require
from arcade_torch.agents.config import Bootstrap, PQNConfig, TimeLimit
from arcade_torch.agents.layout import insert_final_observations, unroll
from arcade_torch.agents.learner import Learner, Training
from arcade_torch.agents.network_loss import NetworkLoss, Reduction
from arcade_torch.agents.returns import QLambdaEstimator


class PQNLoss(NetworkLoss):
    """Half the squared distance of Q(s, a) to its Q(lambda) return, whose values come from the very
    same pass.

    In keys: what the network reads, ``action`` (categorical or one-hot), ``is_init``, ``("next",
    "reward" | "terminated" | "truncated")``, and the true next observations: as ``final_pixels``,
    ``final_index``, ``final_mask`` with ``initial_state`` (batches [N] of
    ``ArcadeCollector.collect()``), or dense under "next" (stock TorchRL batches [B, T]). Rows are
    whole sequences; never shuffle or flatten time. Half of TorchRL's ``DQNLoss(delay_value=False)``
    with TD(lambda), on the same batch.

    Out keys: ``loss`` (with gradient), ``q_mean``, ``target_mean``, ``td_error`` (mean absolute),
    detached.

    Args:
        value_network: any TensorDict module that writes ``action_value`` [*, A], a ``QValueActor``
            for one.
        time_limit: ``"bootstrap"``: a truncation keeps the value of its final frame;
            ``"terminal"``: it terminates.
        bootstrap: ``"next"``: every step has a target; ``"last"``: the last step only lends its
            value.
        delay_value: keep target parameters, which then give the next values (``SoftUpdate``,
            ``HardUpdate``).
        burn_in: first steps that only bring the memory up to date, without gradient; memories with
            one ``store`` only.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        functional: hold the parameters apart from the network, as TorchRL's losses do; False saves
            that time.

    Raises:
        ValueError: an argument out of its range.
        TypeError: the network is no TensorDict module.

    Source: Gallici et al., arXiv 2407.04811; POPGym Arcade (ICML 2026).
    """

    @dataclass
    class _AcceptedKeys:
        """Names of the entries, see ``LossModule.set_keys``."""

        action_value: Key = "action_value"
        action: Key = "action"
        reward: Key = "reward"
        done: Key = "done"
        terminated: Key = "terminated"
        truncated: Key = "truncated"
        is_init: Key = "is_init"
        value_target: Key = "value_target"
        priority: Key = "td_error"
        priority_weight: Key = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TDLambda
    out_keys = ["loss", "q_mean", "target_mean", "td_error"]  # noqa: RUF012 (TorchRL's convention)
    network_names = ("value_network",)

    value_network: TensorDictModuleBase
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        value_network: TensorDictModuleBase,
        *,
        time_limit: TimeLimit = "bootstrap",
        bootstrap: Bootstrap = "next",
        delay_value: bool = False,
        burn_in: int = 0,
        reduction: str = "mean",
        functional: bool = True,
    ) -> None:
        super().__init__()
        self.functional = coerce("functional", functional, bool)
        delay_value = coerce("delay_value", delay_value, bool)
        self.inputs = NetworkInputs(value_network)
        if functional:
            self.convert_to_functional(
                value_network, "value_network", create_target_params=delay_value
            )
        else:
            require(not delay_value, "functional", functional, "True with delay_value")
            self.value_network = value_network
        may_burn_in = len(self.inputs.stores) < 2
        allowed = "0 with memories that differ in store"
        require(may_burn_in or not burn_in, "burn_in", burn_in, allowed)
        self.time_limit = coerce("time_limit", time_limit, TimeLimit)
        self.bootstrap = coerce("bootstrap", bootstrap, Bootstrap)
        self.delay_value = delay_value
        self.burn_in = coerce("burn_in", burn_in, CountOrZero)
        self.reduction = coerce("reduction", reduction, Reduction)
        self._default_value_estimator()

    def _set_in_keys(self) -> None:
        """Set ``in_keys`` to the entries that every batch holds; plain tensors are taken in this
        order. Who wants another order assigns it after the names are set.
        """
        keys = self.tensor_keys
        roots = dict.fromkeys(
            [*self.inputs.observation_keys, *self.inputs.state_keys, keys.action, keys.is_init]
        )
        outcome = [("next", key) for key in (keys.reward, keys.terminated, keys.truncated)]
        following = [("next", key) for key in self.inputs.observation_keys if key != keys.is_init]
        self.in_keys = [*roots, *outcome, *following]

    def make_value_estimator(
        self, value_type: ValueEstimators | ValueEstimatorBase | None = None, **hyperparams: Any
    ) -> None:
        """Choose how targets are made.

        Args:
            value_type: an estimator of TorchRL (TD0, TD1, TDLambda) or an instance; None for
                :class:`QLambdaEstimator`.
            **hyperparams: ``gamma`` (0.99) and ``lmbda`` (0.95).
        """
        if value_type is None:
            self._value_estimator = QLambdaEstimator(**hyperparams)
            self._forward_value_estimator_keys()
        elif isinstance(value_type, ValueEstimatorBase):
            super().make_value_estimator(value_type, **hyperparams)
        else:
            supported = (ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda)
            dispatch_value_estimator(self, value_type, supported=supported, **hyperparams)

    def _default_value_estimator(self) -> None:
        self.make_value_estimator()

    def prepare(self, batch: TensorDictBase) -> TensorDict:
        """Insert the final observations, once for all minibatches; rows of the result are what
        :meth:`forward` takes.

        See :func:`insert_final_observations`, whose result [N] it is.
        """
        keys = {
            x: getattr(self.tensor_keys, x)
            for x in ("action", "is_init", "reward", "done", "terminated", "truncated")
        }
        return insert_final_observations(batch, self.inputs, self.time_limit, self.burn_in, **keys)

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss and metrics of a batch, and the priority of its steps, which is written into it.

        Args:
            tensordict: sequences [N], a stock batch [..., T], or rows of what :meth:`prepare` gave,
                which get no priorities; with ``priority_weight``, [N] or one a step, if the loss is
                to be weighted.

        Returns:
            The out keys.

        Raises:
            KeyError: an entry is missing.
            ValueError: a needed next observation or recurrent state is not in the batch.
        """
        prepared = is_prepared(tensordict)
        data = tensordict if prepared else self.prepare(tensordict)
        steps = data["reward"].shape[1] - (self.bootstrap == "last")
        if steps == 0:
            raise ValueError("bootstrap must be 'next' where sequences are of one step; got 'last'")
        with self._with_parameters():
            q = unroll(self.value_network, self.inputs, data, self.tensor_keys.action_value)
        if q.ndim != 3:
            name = f"{self.tensor_keys.action_value!r} of the network"
            require(False, name, list(q.shape), "[B, T, A], one number an action")
        action = _indices(data["action"][:, :steps], q.shape[-1])
        if not prepared:  # rows of a window that a learner has prepared wait for nothing
            _check_range(action, q.shape[-1])
        chosen = _chosen_values(q, data["position"][:, :steps], action)
        target = self.targets(data, q.detach(), steps)

        rows = tensordict
        if not prepared and is_stock(tensordict, self.tensor_keys.is_init):
            rows = tensordict[..., self.burn_in : self.burn_in + steps]  # its masks are of steps
            chosen = chosen.reshape(rows.shape)
            target = target.reshape(rows.shape)
        error = chosen - target
        mask = data.get("mask", None)
        if mask is not None:
            rows = with_mask(rows, mask[:, :steps].reshape(error.shape))
        weight = self._maybe_get_priority_weight(rows)
        if weight is not None:
            if weight.shape == (*error.shape, 1):
                weight = weight.squeeze(-1)
            weight = expand_as_right(weight, error)
        loss = self._reduce_loss(0.5 * error.square(), rows, weights=weight)

        error_size = error.detach().abs()
        if not prepared and not tensordict.is_locked:
            tensordict[self.tensor_keys.priority] = self._priority(error_size, data)
        out = TensorDict({"loss": loss}, batch_size=[])
        metrics = {"q_mean": chosen.detach(), "target_mean": target, "td_error": error_size}
        for name, value in metrics.items():
            out[name] = self._reduce_loss(value, rows, reduction="mean")
        return out

    def _with_parameters(self) -> AbstractContextManager[Any]:
        """While open, the network has the loss's parameters."""
        if not self.functional:
            return nullcontext()
        opened: AbstractContextManager[Any] = self.value_network_params.to_module(
            self.value_network, preserve_module_state=False
        )
        return opened

    def _priority(self, error_size: Tensor, data: TensorDictBase) -> Tensor:
        """The priority of all steps [..., L, 1]: the error where it is trained, else its mean."""
        steps = error_size.shape[-1]
        length = self.burn_in + data["reward"].shape[1]
        size = error_size.unsqueeze(-1)
        mean = size.mean(-2, keepdim=True).repeat_interleave(length, -2)
        return mean.slice_scatter(size, -2, self.burn_in, self.burn_in + steps)

    @torch.no_grad()
    def targets(self, data: TensorDictBase, q: Tensor, steps: int) -> Tensor:
        """Returns of the first S ``steps`` of what :meth:`prepare` gave, from Q-values [B, L + K,
        A]: float [B, S].
        """
        next_value = self.next_values(data, q, steps)
        keys = self.tensor_keys
        outcome = TensorDict(batch_size=next_value.shape)
        outcome["next", keys.reward] = data["reward"][:, :steps, None]
        outcome["next", keys.terminated] = data["terminated"][:, :steps, None]
        outcome["next", keys.done] = data["cut"][:, :steps, None]
        estimate: Callable[..., Tensor] = self.value_estimator.value_estimate
        return estimate(outcome, next_value=next_value.unsqueeze(-1)).squeeze(-1)

    @torch.no_grad()
    def next_values(self, data: TensorDictBase, q: Tensor, steps: int) -> Tensor:
        """Best Q-values of the true next observations, float [B, S]; of the target network if there
        is one.
        """
        if self.delay_value:
            with self.target_value_network_params.to_module(
                self.value_network, preserve_module_state=False
            ):
                q = unroll(self.value_network, self.inputs, data, self.tensor_keys.action_value)
        value = q.amax(-1)
        following = (data["position"][:, :steps] + 1).clamp_max(value.shape[1] - 1)
        return value.gather(1, following)


def _indices(action: Tensor, num_actions: int) -> Tensor:
    """Actions as int64 [B, S].

    Args:
        action: categorical [B, S] or [B, S, 1], or one-hot [B, S, A].
        num_actions: A.
    """
    if action.ndim == 3 and action.shape[-1] == num_actions:
        action = action.int().argmax(-1)
    return action.reshape(action.shape[:2]).long()


def _chosen_values(q: Tensor, position: Tensor, action: Tensor) -> Tensor:
    """The Q-values of the actions that were taken, float [B, S].

    Args:
        q: float [B, L + K, A].
        position: int64 [B, S], where the observation of each step stands.
        action: int64 [B, S].
    """
    # in two steps: an action that there is not would be one of the next observation
    of_steps = q.gather(1, position.unsqueeze(-1).expand(-1, -1, q.shape[-1]))
    return of_steps.gather(2, action.unsqueeze(-1)).squeeze(-1)


def _check_range(action: Tensor, num_actions: int) -> None:
    """Refuse actions that the network has no value for (ValueError); on a GPU, whose work a look
    would wait for, nothing is refused.
    """
    if action.device.type != "cpu" or torch.compiler.is_compiling():
        return
    try:
        lowest, highest = (int(x) for x in action.aminmax())
    except RuntimeError:  # inside of vmap they have no values to read
        return
    if lowest < 0 or highest >= num_actions:
        raise ValueError(
            f"actions must be from 0 to {num_actions - 1}, the outputs of the network; got {lowest}"
            f" to {highest}"
        )


class PQN(Learner):
    """Learns from every window for some epochs, then forgets it.

    Args:
        network: writes ``action_value``.
        config: numbers of PQN.
        training: of the run.
    """

    config: PQNConfig
    loss: PQNLoss

    def __init__(
        self, network: TensorDictModuleBase, config: PQNConfig, training: Training
    ) -> None:
        loss = PQNLoss(
            network, time_limit=config.time_limit, bootstrap=config.bootstrap, functional=False
        )
        loss.make_value_estimator(gamma=config.gamma, lmbda=config.lam)
        super().__init__(loss, config, training, optimizer="radam")

    def update(self, batch: TensorDictBase, frames: float) -> dict[str, float]:
        """Learn from one window.

        Args:
            batch: sequences [num_envs] of ``ArcadeCollector.collect()``.
            frames: frames counted before this window.

        Returns:
            Means over the gradient steps, by column of ``metrics.csv``.

        Raises:
            NonFiniteError: the loss, the gradient or a weight is not finite.
        """
        data = self.loss.prepare(batch)
        for minibatch in self.minibatches(data):
            self.gradient_step(minibatch, frames)
            frames += self.frames_per_step
        return self.take_metrics()
