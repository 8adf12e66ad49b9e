"""PPO with a memory in actor and critic, or in neither."""

from contextlib import nullcontext
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType
from torchrl.modules import PopArtValueNorm, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from arcade_torch.agents.config import PPOConfig, TimeLimit, coerce
from arcade_torch.agents.learner import Learner, Training
from arcade_torch.agents.sequences import (
    NetworkInputs,
    as_steps,
    insert_final_observations,
    is_stock,
    solve_backward,
    unroll,
    values_and_traces,
)


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
        next_value: float [B, T], value of the true next observation.
        terminated: bool [B, T]; this and what follows as in :func:`q_lambda_return`.
        truncated: bool [B, T].
        gamma: discount per step, in [0, 1].
        lam: trace decay in [0, 1]; 0 gives the one-step error, 1 the Monte-Carlo return minus the value.
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
    after, trace = values_and_traces(reward, next_value, terminated, truncated, gamma, lam, time_limit, value)
    return solve_backward(reward + gamma * after - value, trace)


class SequenceGAE(nn.Module):
    """Advantages by one pass of the critic over each sequence, final observations read where they belong.

    A value estimator for :class:`PPOLoss`: writes ``advantage``, ``value_target``, ``state_value`` [..., L, 1].

    Args:
        critic: any TensorDict module that writes ``state_value`` [*, 1].
        gamma: discount per step, in [0, 1].
        lmbda: lambda of the estimate, in [0, 1].
        time_limit: ``"bootstrap"``: a truncation keeps the value of its final frame; ``"terminal"``: it terminates.
        chunks: parts that the rows are read in, which bounds memory.
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
        self.gamma, self.lmbda, self.chunks = gamma, lmbda, chunks
        self.names: dict[str, Any] = {key: key for key in ("reward", "terminated", "advantage", "value_target")}
        self.names["value"] = "state_value"

    def set_keys(self, **names: Any) -> None:
        """Other names of ``reward``, ``terminated``, ``advantage``, ``value_target``, ``value``; the rest is unused."""
        self.names |= {name: key for name, key in names.items() if name in self.names}

    @torch.no_grad()
    def forward(self, batch: TensorDictBase, params: Any = None, target_params: Any = None) -> TensorDictBase:
        """Estimate advantages; gives the same object, with the three entries.

        Args:
            batch: sequences [N] of ``ArcadeCollector.collect()``, or a stock batch [..., L] with next observations.
            params: parameters of the critic; default those it has.
            target_params: not looked at.
        """
        names = {name: self.names[name] for name in ("reward", "terminated")}
        data = insert_final_observations(batch, self.inputs, self.time_limit, **names)
        with nullcontext() if params is None else params.to_module(self.critic, preserve_module_state=False):
            values = [unroll(self.critic, self.inputs, rows, self.names["value"]) for rows in data.chunk(self.chunks)]
        value, position = torch.cat(values).squeeze(-1), data["position"]
        here, following = value.gather(1, position), value.gather(1, (position + 1).clamp_max(value.shape[1] - 1))
        advantage = gae(data["reward"], here, following, data["terminated"], data["cut"], self.gamma, self.lmbda)
        entries = {"advantage": advantage, "value_target": advantage + here, "value": here}
        shape = batch.shape if is_stock(batch) else advantage.shape
        for key, entry in entries.items():
            batch[self.names[key]] = entry.reshape(shape).unsqueeze(-1)
        return batch


class PPOLoss(ClipPPOLoss):
    """TorchRL's ``ClipPPOLoss`` over whole sequences of a recurrent actor and critic.

    Differences: advantages come from :class:`SequenceGAE` before the first gradient step and are normalised in each
    minibatch by the population deviation plus 1e-8, unless an ``advantage_norm`` divides them (``update`` it once a
    window with what it is to follow, advantages or value targets); the value loss is half the squared error, clipped
    like the ratio; the entropy is not checked for NaN in every call, which would wait for the device. In keys and out
    keys are those of ``ClipPPOLoss``, and ``loss_prediction`` where that has a weight.

    Args:
        actor_network: a probabilistic TensorDict module (:func:`make_actor`, ``ProbabilisticActor``).
        critic_network: any TensorDict module that writes ``state_value`` [*, 1].
        time_limit: see :class:`SequenceGAE`.
        critic_coeff: weight of the value loss.
        prediction_coeff: weight of ``prediction_error``, which the actor has to write then (``predicts=True``).
        **kwargs: ``clip_epsilon`` (0.2), ``entropy_coeff`` (0.01) and the others of ``ClipPPOLoss``.

    Source: Schulman et al., arXiv 1707.06347, equations 7 and 9; value clipping as in the published implementation.
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        *,
        time_limit: TimeLimit = "bootstrap",
        critic_coeff: float = 0.5,
        prediction_coeff: float = 0.0,
        **kwargs: Any,
    ) -> None:
        options = {"loss_critic_type": "l2", "clip_value": True, "log_explained_variance": False} | kwargs
        super().__init__(actor_network, critic_network, critic_coeff=0.5 * critic_coeff, **options)
        self.time_limit = coerce("time_limit", time_limit, TimeLimit)
        self.prediction_coeff = prediction_coeff
        self.normalize_advantage = True
        self.inputs = NetworkInputs(TensorDictSequential(actor_network, critic_network))
        self.out_keys = [*self.out_keys, *["loss_prediction"] * bool(prediction_coeff)]  # type: ignore[has-type]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The parts of the loss.

        Args:
            tensordict: sequences [N] of ``ArcadeCollector.collect()`` or rows of them, or a stock batch [B, T]; with
                ``advantage``, ``value_target``, ``state_value`` (else they are estimated with the present critic).

        Returns:
            The out keys of ``ClipPPOLoss``.
        """
        keys = self.tensor_keys
        if tensordict.get(keys.advantage, None) is None:
            tensordict = self.value_estimator(tensordict.copy())
            if self.advantage_norm is not None and self.training:
                self.advantage_norm.update(tensordict[keys.value_target])
        read = (keys.action, keys.sample_log_prob, keys.advantage, keys.value_target, keys.value)
        losses = super().forward(as_steps(tensordict, self.inputs, *read))
        if self.prediction_coeff:
            losses["loss_prediction"] = self.prediction_coeff * self._reduce_loss(self.__dict__.pop("_error"))
        return losses

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """Choose how advantages are made.

        Args:
            value_type: an estimator of TorchRL; None for :class:`SequenceGAE`.
            **hyperparams: of the estimator; of ours ``gamma``, ``lmbda``, ``chunks``, and ``critic``, where the loss's
                own reads what the actor has written (``ActorCriticNetwork.estimator``).
        """
        if value_type is None:
            hyperparams = {"critic": self.critic_network, "time_limit": self.time_limit} | hyperparams
            self._value_estimator = SequenceGAE(**hyperparams)
            self._forward_value_estimator_keys()
        else:
            super().make_value_estimator(value_type, **hyperparams)

    def _default_value_estimator(self) -> None:
        self.make_value_estimator()

    def _standardize_advantage(self, advantage: Tensor, tensordict: TensorDictBase) -> Tensor:
        centred = advantage - advantage.mean()
        return centred / (centred.square().mean().sqrt() + 1e-8)  # finite where all are equal

    def _log_weight(self, tensordict: TensorDictBase, adv_shape: torch.Size) -> tuple[Any, ...]:
        log_weight, dist, _, correction = super()._log_weight(tensordict, adv_shape)
        if self.prediction_coeff:  # the actor has just written it
            self.__dict__["_error"] = tensordict["prediction_error"]
        kl = log_weight.exp() - 1 - log_weight  # never negative, unlike the plain difference
        return log_weight, dist, kl, correction

    def _get_entropy(self, dist: Any, adv_shape: torch.Size) -> Tensor:
        return dist.entropy().unsqueeze(-1)  # type: ignore[no-any-return]


class Choice(Categorical):
    """A categorical distribution that samples something even where logits are NaN.

    ``torch.multinomial`` stops the process there (on CUDA for good), before the learner can name the update.
    """

    deterministic_sample = Categorical.mode  # the name that TorchRL asks for

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw by the largest of ``logits + Gumbel noise``, int64 [*sample_shape, *batch]."""
        logits = self.logits.expand(*sample_shape, *self.logits.shape)
        return (logits - torch.empty_like(logits).exponential_().log()).argmax(-1)


def make_actor(network: TensorDictModuleBase, deterministic: bool = False) -> ProbabilisticActor:
    """A policy that samples from the softmax of ``logits``.

    Args:
        network: any TensorDict module that writes ``logits`` [*, A].
        deterministic: take the most likely action unless told otherwise (``set_exploration_type``).

    Returns:
        TorchRL's ``ProbabilisticActor``; writes ``action`` int64 [*] and ``action_log_prob``.
    """
    return ProbabilisticActor(
        network,
        in_keys=["logits"],
        distribution_class=Choice,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
        default_interaction_type=ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM,
    )


class PPO(Learner):
    """Estimates advantages once a window, then goes over it for some epochs; arguments as in :class:`PQN`.

    The network has an ``actor`` (writes ``logits``), a ``critic`` (``state_value``) and the critic's ``estimator``.
    """

    config: PPOConfig
    loss: PPOLoss

    def __init__(self, network: Any, config: PPOConfig, training: Training) -> None:
        names = ("time_limit", "entropy_coeff", "critic_coeff", "prediction_coeff")
        options: Any = {name: getattr(config, name) for name in names}
        if config.advantage_decay:
            options["advantage_norm"] = PopArtValueNorm(beta=config.advantage_decay, epsilon=1e-8).to(training.device)
        loss = PPOLoss(make_actor(network.actor), network.critic, clip_epsilon=config.clip, **options)
        chunks = config.minibatches
        loss.make_value_estimator(gamma=config.gamma, lmbda=config.lam, chunks=chunks, critic=network.estimator)
        super().__init__(loss, config, training, optimizer="adam")

    def update(self, batch: TensorDictBase, frames: float) -> dict[str, float | None]:
        """Learn from one window, with ``action_log_prob``; see `PQN.update`."""
        data = self.loss.value_estimator(batch)
        if self.loss.advantage_norm is not None:  # a running mean and deviation of whatever it is given
            self.loss.advantage_norm.update(data["advantage"])
        for minibatch in self.minibatches(data):
            left = self.config.entropy_coeff * self.config.entropy_end ** (frames / self.training.total_frames)
            self.loss.entropy_coeff.fill_(left)
            self.gradient_step(minibatch, frames)
            frames += self.frames_per_step
        metrics = self.take_metrics()
        return metrics | {
            "policy_loss": metrics["loss_objective"],
            "value_loss": metrics["loss_critic"] / self.config.critic_coeff if self.config.critic_coeff else None,
            "kl": metrics["kl_approx"],
            "q_mean": float(data["state_value"].mean()),
            "td_error": float(data["advantage"].abs().mean()),
        }
