"""PPO with a memory in actor and critic, or in neither."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
    dispatch,
)
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.modules import PopArtValueNorm
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator

from arcade_torch.agents.batch_checks import (
    Key,
    NetworkInputs,
    entry,
    one_a_step,
    stored_numbers,
    with_mask,
    written,
)
from arcade_torch.agents.checked import Finite, Positive, coerce, require
from arcade_torch.agents.config import PPOConfig, TimeLimit
from arcade_torch.agents.layout import as_steps
from arcade_torch.agents.learner import Learner, Training
from arcade_torch.agents.network_loss import NetworkLoss, Reduction, check_actor
from arcade_torch.agents.policy import make_actor
from arcade_torch.agents.returns import SequenceGAE, normalize
from arcade_torch.envs_jax.validation import plain
from arcade_torch.models.memory import step_mask


def ppo_objective(
    log_prob: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    value: Tensor,
    old_value: Tensor | None,
    value_target: Tensor,
    clip_epsilon: Tensor,
) -> dict[str, Tensor]:
    """The clipped losses of policy and value, one number a step; all arguments have one shape.

    Args:
        log_prob: of the action that was taken, by the policy that learns.
        old_log_prob: the same by the policy that acted.
        advantage: of the action, normalised.
        value: of the observation, by the critic that learns.
        old_value: the same before the first gradient step; None leaves the value unclipped.
        value_target: what the value should have been.
        clip_epsilon: how far the ratio may leave 1, and the value its old one, before the gradient
            ends.

    Returns:
        ``policy_loss`` and ``value_loss`` with gradient; without one ``kl``, an estimate that is
        never negative (Schulman, "Approximating KL divergence", k3), and ``clipped`` and
        ``value_clipped``, 1 where a clip is at work.

    Source: Schulman et al., arXiv 1707.06347, equation 7; value clipping as in the published code.
    """
    log_ratio = log_prob - old_log_prob
    ratio = log_ratio.exp()
    clipped_ratio = ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon)
    policy_loss = -torch.minimum(ratio * advantage, clipped_ratio * advantage)

    value_loss = 0.5 * (value - value_target).square()
    value_clipped = torch.zeros_like(value)
    if old_value is not None:
        change = value - old_value
        clipped_value = old_value + change.clamp(-clip_epsilon, clip_epsilon)
        value_loss = torch.maximum(value_loss, 0.5 * (clipped_value - value_target).square())
        value_clipped = (change.detach().abs() > clip_epsilon).to(value.dtype)

    return {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "kl": (ratio - 1 - log_ratio).detach(),
        "clipped": (ratio.detach() != clipped_ratio.detach()).to(ratio.dtype),
        "value_clipped": value_clipped,
    }


def entropy_of(policy: Distribution) -> Tensor:
    """The entropy of a policy; from one draw where there is no formula, as TorchRL's losses do."""
    try:
        return policy.entropy()
    except NotImplementedError:
        drawn = policy.rsample() if policy.has_rsample else policy.sample()
        return -policy.log_prob(drawn)


class PPOLoss(NetworkLoss):
    """:func:`ppo_objective` and an entropy bonus over whole sequences of a recurrent actor and
    critic.

    In keys: what the networks read, ``action``, ``action_log_prob``, ``is_init``, and what
    :class:`SequenceGAE` reads or writes. Advantages are made before the first gradient step and are
    normalised in each minibatch, unless an ``advantage_norm`` divides them (``update`` it once a
    window with what it is to follow, advantages or value targets).

    Out keys, those of TorchRL's ``ClipPPOLoss``: ``loss_objective``, ``loss_critic``,
    ``loss_entropy`` (with gradient, weighted; their sum is to be minimised), ``entropy``,
    ``kl_approx``, ``clip_fraction``, ``value_clip_fraction``; and ``loss_prediction`` where that
    has a weight.

    Args:
        actor_network: a probabilistic TensorDict module (:func:`make_actor`,
            ``ProbabilisticActor``).
        critic_network: any TensorDict module that writes ``state_value`` [*, 1]; None where the
            actor network writes it beside the logits, so that one pass gives both.
        time_limit: see :class:`SequenceGAE`.
        clip_epsilon: see :func:`ppo_objective`; a buffer, ``loss.clip_epsilon.fill_(...)`` moves
            it.
        clip_value: whether the value is clipped as well.
        entropy_coeff: weight of the entropy bonus; a buffer.
        critic_coeff: weight of the value loss, which is half the squared error.
        prediction_coeff: weight of ``prediction_error``, which the actor has to write then
            (``predicts=True``).
        normalize_advantage: whether advantages are normalised in each minibatch.
        advantage_norm: of TorchRL, such as ``PopArtValueNorm``; divides advantages instead.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        functional: hold the parameters apart from the networks, as TorchRL's losses do; False saves
            that time.

    Raises:
        ValueError: an argument out of its range, or nothing writes the value.
        TypeError: ``actor_network`` draws no actions, or a network is no TensorDict module.

    Source: Schulman et al., arXiv 1707.06347, equation 9. Equal to ``ClipPPOLoss`` with
    ``loss_critic_type="l2"``, ``clip_value=True`` and half its ``critic_coeff``, on the same batch.
    """

    @dataclass
    class _AcceptedKeys:
        """Names of the entries, see ``LossModule.set_keys``."""

        advantage: Key = "advantage"
        value_target: Key = "value_target"
        value: Key = "state_value"
        sample_log_prob: Key = "action_log_prob"
        action: Key = "action"
        reward: Key = "reward"
        done: Key = "done"
        terminated: Key = "terminated"
        truncated: Key = "truncated"
        is_init: Key = "is_init"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.GAE
    network_names = ("actor_network", "critic_network")

    actor_network: ProbabilisticTensorDictSequential
    critic_network: TensorDictModuleBase | None
    actor_network_params: Any
    critic_network_params: Any
    target_actor_network_params: Any
    target_critic_network_params: Any

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase | None = None,
        *,
        time_limit: TimeLimit = "bootstrap",
        clip_epsilon: float = 0.2,
        clip_value: bool = True,
        entropy_coeff: float = 0.01,
        critic_coeff: float = 0.5,
        prediction_coeff: float = 0.0,
        normalize_advantage: bool = True,
        advantage_norm: Any = None,
        reduction: str = "mean",
        functional: bool = True,
    ) -> None:
        super().__init__()
        self.functional = coerce("functional", functional, bool)
        self.critic_network = None
        check_actor(actor_network)
        if critic_network is None:
            require(
                _may_write_value(actor_network, self.tensor_keys.value),
                "critic_network",
                critic_network,
                "given, unless the actor network writes state_value",
            )
            self.inputs = NetworkInputs(actor_network)
        else:
            NetworkInputs(critic_network)
            self.inputs = NetworkInputs(TensorDictSequential(actor_network, critic_network))
        if not functional:
            self.actor_network = actor_network
            self.critic_network = critic_network
        else:
            self.convert_to_functional(actor_network, "actor_network")
            if critic_network is not None:
                self.convert_to_functional(critic_network, "critic_network")
        self.time_limit = coerce("time_limit", time_limit, TimeLimit)
        self.clip_value = coerce("clip_value", clip_value, bool)
        self.critic_coeff = coerce("critic_coeff", plain(critic_coeff), Finite)
        self.prediction_coeff = coerce("prediction_coeff", plain(prediction_coeff), Finite)
        self.normalize_advantage = coerce("normalize_advantage", normalize_advantage, bool)
        has_scale = advantage_norm is None or hasattr(advantage_norm, "scale")
        require(has_scale, "advantage_norm", advantage_norm, "None or such as PopArtValueNorm")
        self.advantage_norm = advantage_norm
        self.reduction = coerce("reduction", reduction, Reduction)
        clip_epsilon = coerce("clip_epsilon", plain(clip_epsilon), Positive)
        entropy_coeff = coerce("entropy_coeff", plain(entropy_coeff), Finite)
        device = next((p.device for p in self.parameters()), torch.device("cpu"))
        for name, number in (("clip_epsilon", clip_epsilon), ("entropy_coeff", entropy_coeff)):
            value = torch.full((), number, dtype=torch.float32, device=device)
            self.register_buffer(name, value)
        self.clip_epsilon: Tensor
        self.entropy_coeff: Tensor
        self.out_keys = ["loss_objective", "loss_critic", "loss_entropy"]
        self.out_keys += ["entropy", "kl_approx", "clip_fraction", "value_clip_fraction"]
        if prediction_coeff:
            self.out_keys.append("loss_prediction")
        self._default_value_estimator()

    def _set_in_keys(self) -> None:
        """Set ``in_keys`` to the entries that every batch holds; plain tensors are taken in this
        order. Who wants another order assigns it after the names are set.
        """
        keys = self.tensor_keys
        inputs = [*self.inputs.observation_keys, *self.inputs.state_keys]
        acted = [keys.action, keys.sample_log_prob]
        outcome = [("next", name) for name in (keys.reward, keys.done, keys.terminated)]
        following = [("next", key) for key in self.inputs.observation_keys if key != keys.is_init]
        self.in_keys = list(dict.fromkeys([*inputs, *acted, *outcome, *following]))

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """Choose how advantages are made.

        Args:
            value_type: an estimator of TorchRL; None for :class:`SequenceGAE`.
            **hyperparams: of the estimator; of ours ``gamma``, ``lmbda``, ``chunks``, and
                ``critic``, another one than that of the loss.
        """
        if value_type is None:
            critic = self.critic_network
            if critic is None:
                critic = TensorDictSequential(*_parts(self.actor_network)[:-1])
            hyperparams.setdefault("critic", critic)
            hyperparams.setdefault("time_limit", self.time_limit)
            self._value_estimator = SequenceGAE(**hyperparams)
        else:
            of_torchrl = [kind for kind in ValueEstimators if kind is not ValueEstimators.VTrace]
            dispatch_value_estimator(self, value_type, supported=of_torchrl, **hyperparams)
        self._forward_value_estimator_keys()

    def _default_value_estimator(self) -> None:
        self.make_value_estimator()

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        """Let the estimator know the names of the entries."""
        names = ["advantage", "value_target", "value", "sample_log_prob"]
        names += ["reward", "done", "terminated"]
        if isinstance(self._value_estimator, SequenceGAE):
            names += ["action", "truncated", "is_init"]
        if self._value_estimator is not None:
            self._value_estimator.set_keys(
                **{name: getattr(self.tensor_keys, name) for name in names}
            )
        self._set_in_keys()

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The parts of the loss.

        Args:
            tensordict: sequences [N] of ``ArcadeCollector.collect()`` or rows of them, or a stock
                batch [B, T]; with ``advantage``, ``value_target``, ``state_value`` (else they are
                estimated with the present critic).

        Returns:
            The out keys.
        """
        tensordict = self._prepared(tensordict)
        keys = self.tensor_keys
        stored = (keys.sample_log_prob, keys.advantage, keys.value_target, keys.value)
        steps = as_steps(tensordict, self.inputs, keys.action, *stored).copy()
        mask = step_mask(tensordict, steps.shape)
        given = stored_numbers(steps, stored if self.clip_value else stored[:-1], mask)
        for key in self.inputs.state_keys:
            if key in steps:
                steps[key] = steps[key].detach()
        steps = steps.exclude(keys.value, "prediction_error")  # what is stored has no gradient

        with self._parameters_in(self.actor_network, "actor_network_params"):
            policy = self.actor_network.get_dist(steps)
        if self.critic_network is not None:
            with self._parameters_in(self.critic_network, "critic_network_params"):
                self.critic_network(steps)
        value = written(steps, keys.value, self.critic_network or self.actor_network)
        value = one_a_step(keys.value, value, steps)
        log_prob = policy.log_prob(_fitting(steps[keys.action], policy))
        terms = ppo_objective(
            log_prob=one_a_step("log_prob of the policy", log_prob, steps),
            old_log_prob=given[keys.sample_log_prob],
            advantage=self._scaled(given[keys.advantage], mask),
            value=value,
            old_value=given.get(keys.value),
            value_target=given[keys.value_target],
            clip_epsilon=self.clip_epsilon,
        )
        entropy = one_a_step("entropy of the policy", entropy_of(policy), steps)

        losses = {
            "loss_objective": terms["policy_loss"],
            "loss_critic": self.critic_coeff * terms["value_loss"],
            "loss_entropy": -self.entropy_coeff * entropy,
        }
        if self.prediction_coeff:
            losses["loss_prediction"] = self.prediction_coeff * steps["prediction_error"]
        diagnostics = {
            "entropy": entropy.detach(),
            "kl_approx": terms["kl"],
            "clip_fraction": terms["clipped"],
            "value_clip_fraction": terms["value_clipped"],
        }
        counted = with_mask(tensordict, mask)
        out = TensorDict(batch_size=[])
        for name, each_step in losses.items():
            out[name] = self._reduce_loss(each_step, counted)
        for name, each_step in diagnostics.items():
            out[name] = self._reduce_loss(each_step, counted, reduction="mean")
        return out

    def _prepared(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The batch with start flags under our name and with advantages; a copy where it has
        none.
        """
        keys = self.tensor_keys
        if keys.is_init != "is_init":
            tensordict = tensordict.copy().set("is_init", entry(tensordict, keys.is_init))
        if tensordict.get(keys.advantage, None) is not None:
            return tensordict
        tensordict = self.value_estimator(tensordict.copy())
        if self.advantage_norm is not None and self.training:
            target = tensordict[keys.value_target]
            mask = step_mask(tensordict, target.shape[:-1])
            self.advantage_norm.update(target if mask is None else target[mask])
        return tensordict

    def _parameters_in(self, network: Any, name: str) -> AbstractContextManager[Any]:
        """While open, the network has the loss's parameters."""
        if not self.functional:
            return nullcontext()
        parameters: Any = getattr(self, name)
        opened: AbstractContextManager[Any] = parameters.to_module(
            network, preserve_module_state=False
        )
        return opened

    def _scaled(self, advantage: Tensor, mask: Tensor | None) -> Tensor:
        if self.advantage_norm is not None:
            return advantage / self.advantage_norm.scale()  # type: ignore[no-any-return]
        if not self.normalize_advantage:
            return advantage
        return normalize(advantage, None if mask is None else mask.unsqueeze(-1))


def _fitting(action: Tensor, policy: Distribution) -> Tensor:
    """Categorical actions [*, 1] as [*], or each would be compared with all."""
    has_one_more = not policy.event_shape and action.shape == (*policy.batch_shape, 1)
    return action.squeeze(-1) if has_one_more else action


def _parts(actor: ProbabilisticTensorDictSequential) -> list[nn.Module]:
    """The modules of an actor in their order; the last one draws actions."""
    modules: Any = actor.module
    return list(modules.values() if isinstance(modules, nn.ModuleDict) else modules)


def _may_write_value(actor: ProbabilisticTensorDictSequential, name: Key) -> bool:
    """Whether an actor network writes the value, or something that ``set_keys`` may call so: an
    entry that the distribution does not read, and that is no state.
    """
    parts = _parts(actor)
    head: Any = parts[-1]
    used = {*head.in_keys, *head.out_keys}
    for key in TensorDictSequential(*parts[:-1]).out_keys:
        if key == name or (key not in used and unravel_key(key)[0] != "next"):
            return True
    return False


class PPO(Learner):
    """Estimates advantages once a window, then goes over it for some epochs; arguments as in
    :class:`PQN`.

    The network writes ``logits`` and ``state_value``; its ``critic`` writes the value alone.
    """

    config: PPOConfig
    loss: PPOLoss

    def __init__(self, network: Any, config: PPOConfig, training: Training) -> None:
        names = ("time_limit", "entropy_coeff", "critic_coeff", "prediction_coeff")
        options: Any = {name: getattr(config, name) for name in names}
        if config.advantage_decay:
            options["advantage_norm"] = PopArtValueNorm(
                beta=config.advantage_decay, epsilon=1e-8, device=training.device
            )
        loss = PPOLoss(make_actor(network), clip_epsilon=config.clip, functional=False, **options)
        loss.make_value_estimator(
            gamma=config.gamma,
            lmbda=config.lam,
            chunks=config.minibatches,
            critic=network.critic,
        )
        super().__init__(loss, config, training, optimizer="adam")

    def update(self, batch: TensorDictBase, frames: float) -> dict[str, float | None]:
        """Learn from one window, with ``action_log_prob``; see `PQN.update`."""
        data = self.loss.value_estimator(batch)
        # a running mean and deviation of whatever it is given
        if self.loss.advantage_norm is not None:
            self.loss.advantage_norm.update(data["advantage"])
        for minibatch in self.minibatches(data):
            progress = frames / self.training.total_frames
            share_left = self.config.entropy_end**progress
            self.loss.entropy_coeff.fill_(self.config.entropy_coeff * share_left)
            self.gradient_step(minibatch, frames)
            frames += self.frames_per_step
        metrics = self.take_metrics()
        value_loss = None
        if self.config.critic_coeff:
            value_loss = metrics["loss_critic"] / self.config.critic_coeff
        return metrics | {
            "policy_loss": metrics["loss_objective"],
            "value_loss": value_loss,
            "kl": metrics["kl_approx"],
            "q_mean": float(data["state_value"].mean()),
            "td_error": float(data["advantage"].abs().mean()),
        }
