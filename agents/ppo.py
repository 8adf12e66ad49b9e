"""PPO with a memory in actor and critic, or in neither."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from arcade_torch.agents.learner_config import LearnerConfig
from arcade_torch.agents.protocols import ActorCritic
from arcade_torch.agents.targets import TimeLimit, gae
from arcade_torch.agents.window import Key, Window, WindowKeys, outputs_along, read_window


@dataclass(frozen=True)
class PPOConfig(LearnerConfig):
    """Numbers of the PPO learner; the defaults are the paper's, the step size falls over the whole run.

    Source: POPGym Arcade (ICML 2026), hyperparameter table of PPO; Schulman et al., arXiv 1707.06347.
    """

    GROUP: ClassVar[str] = "ppo"

    learning_rate: float = 1e-4
    """Step size at the start."""
    learning_rate_end: float = 1e-10
    """Step size after the decay."""
    learning_rate_share: float = 1.0
    """Share of the run's frames over which the step size falls linearly; 0 starts at the end value."""
    lam: float = 0.95
    """Lambda of the generalised advantage estimate, in [0, 1]."""
    clip: float = 0.2
    """How far the probability ratio, and the value, may move in an update before the gradient stops."""
    entropy_weight: float = 0.01
    """Weight of the entropy bonus."""
    value_weight: float = 0.5
    """Weight of the value loss."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        super().__post_init__()
        self._split_evenly("num_envs", self.num_envs)
        self._each(("lam",), lambda x: 0.0 <= x <= 1.0, "a number in [0, 1]")
        self._each(("clip",), lambda x: x > 0.0, "a number > 0")
        self._each(("entropy_weight", "value_weight"), lambda x: x >= 0.0, "a number >= 0")


@dataclass
class PPOKeys(WindowKeys):
    """Names of the entries a window is read from, and of the log-probabilities of the actions taken."""

    action_log_prob: Key = "action_log_prob"

    def required(self) -> list[object]:
        """Entries that every batch must hold."""
        return [*super().required(), self.action_log_prob]


class PPOOutput(NamedTuple):
    """Parts of the loss, scalars with gradient, and what was found on the way, detached.

    ``policy``, ``value`` and ``entropy`` are the three parts without their weights, ``loss`` is their weighted sum;
    ``log_prob`` and ``state_value`` float [B, L] are those of the present network.
    """

    loss: Tensor
    policy: Tensor
    value: Tensor
    entropy: Tensor
    log_prob: Tensor
    state_value: Tensor
    kl: Tensor
    clip_share: Tensor


class PPOLoss(LossModule):
    """Clipped policy loss, clipped value loss, entropy bonus, over whole sequences.

    Advantages come from one pass of the critic over the whole window before the first gradient step, in which final
    observations are read with the recurrent state that led to them. They are normalised in each minibatch (population
    deviation plus 1e-8). In keys: those of ``QLoss``, and ``action_log_prob`` of the actions taken. Out keys:
    ``loss_objective``, ``loss_critic``, ``loss_entropy`` (weighted, scalars with gradient, as TorchRL's ``ClipPPOLoss``
    names them), ``entropy``, ``kl_approx``, ``clip_fraction``, detached.

    Args:
        network: an ``ActorCriticNetwork``, or any module with its ``encode``, ``remember``, ``initial_state`` and
            ``critic``.
        gamma: discount.
        lam: lambda of the advantage estimate.
        time_limit: see :class:`PPOConfig`.
        clip: see :class:`PPOConfig`.
        entropy_weight: see :class:`PPOConfig`.
        value_weight: see :class:`PPOConfig`.

    Source: Schulman et al., arXiv 1707.06347, equations 7 and 9; value clipping as in the published implementation.
    """

    _AcceptedKeys = PPOKeys
    default_keys = PPOKeys
    out_keys = ("loss_objective", "loss_critic", "loss_entropy", "entropy", "kl_approx", "clip_fraction")

    network: ActorCritic

    def __init__(
        self,
        network: ActorCritic,
        gamma: float = 0.99,
        lam: float = 0.95,
        time_limit: TimeLimit = "bootstrap",
        clip: float = 0.2,
        entropy_weight: float = 0.01,
        value_weight: float = 0.5,
    ) -> None:
        super().__init__()
        self.network = network
        self.gamma, self.lam, self.time_limit = gamma, lam, time_limit
        self.clip, self.entropy_weight, self.value_weight = clip, entropy_weight, value_weight

    @classmethod
    def from_config(cls, network: ActorCritic, config: PPOConfig) -> "PPOLoss":
        """The loss that ``config`` describes."""
        weights = config.entropy_weight, config.value_weight
        return cls(network, config.gamma, config.lam, config.time_limit, config.clip, *weights)

    @property
    def functional(self) -> bool:
        """False: the network's parameters are used where they are."""
        return False

    @property
    def in_keys(self) -> list[object]:
        """Entries that every batch must hold."""
        return cast(PPOKeys, self.tensor_keys).required()

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """There is no separate value estimator."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss and metrics of a batch taken as one minibatch, as a TensorDict of scalars.

        Args:
            tensordict: sequences [B] or a stock batch [B, T].

        Returns:
            The out keys.

        Raises:
            ValueError: a needed next observation or recurrent state is not in the batch.
        """
        out = self.compute(self.prepare(self.read(tensordict)))
        parts = {
            "loss_objective": out.policy,
            "loss_critic": self.value_weight * out.value,
            "loss_entropy": -self.entropy_weight * out.entropy,
            "entropy": out.entropy.detach(),
            "kl_approx": out.kl,
            "clip_fraction": out.clip_share,
        }
        return TensorDict(parts, batch_size=[])

    def read(self, tensordict: TensorDictBase) -> Window:
        """Read a batch into plain tensors, with the log-probabilities of the actions taken."""
        keys = cast(PPOKeys, self.tensor_keys)
        window = read_window(tensordict, keys, self.time_limit, "next", self.network.initial_state)
        log_prob: Tensor = tensordict.get(keys.action_log_prob)
        return window.with_extras(log_prob=log_prob.reshape(window.action.shape))

    @torch.no_grad()
    def prepare(self, window: Window, rows_at_once: int | None = None) -> Window:
        """Advantages and value targets with the present critic.

        Args:
            window: from :meth:`read`.
            rows_at_once: rows in one pass, which bounds memory; default all.

        Returns:
            The window without final observations, with ``extras`` ``advantage``, ``value_target`` and ``state_value``
            [B, L]; its rows are what :meth:`compute` takes.
        """
        every, step = list(range(window.action.shape[0])), rows_at_once or window.action.shape[0]
        parts = [self._values(window.rows(every[i : i + step])) for i in range(0, len(every), step)]
        value, next_value = (torch.cat(column) for column in zip(*parts, strict=True))
        advantage = gae(
            window.reward,
            value,
            next_value,
            window.terminated,
            window.truncated,
            self.gamma,
            self.lam,
            self.time_limit,
        )
        return window.roots().with_extras(advantage=advantage, value_target=advantage + value, state_value=value)

    def _values(self, window: Window) -> tuple[Tensor, Tensor]:
        """Values of the observations and of the true next observations, [B, L] each."""
        value = outputs_along(self.network.critic, window, window.state["critic"]).squeeze(-1)
        following = (window.position + 1).clamp_max(value.shape[1] - 1)
        return value.gather(1, window.position), value.gather(1, following)

    def compute(self, window: Window) -> PPOOutput:
        """The loss of a minibatch.

        Args:
            window: from :meth:`prepare`, or rows of it.

        Returns:
            Loss and its parts.
        """
        logits, value = self.network.split(outputs_along(self.network, window))
        log_probs = logits.log_softmax(-1)
        log_prob = log_probs.gather(-1, window.action.unsqueeze(-1)).squeeze(-1)
        entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
        log_ratio = log_prob - window.extras["log_prob"]
        ratio, advantage = log_ratio.exp(), normalise(window.extras["advantage"])
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        policy = -torch.minimum(ratio * advantage, clipped * advantage).mean()
        value_loss = self._value_loss(value, window.extras["state_value"], window.extras["value_target"])
        loss = policy + self.value_weight * value_loss - self.entropy_weight * entropy
        with torch.no_grad():
            kl = (ratio - 1 - log_ratio).mean()
            clip_share = ((ratio - 1).abs() > self.clip).to(ratio.dtype).mean()
        return PPOOutput(loss, policy, value_loss, entropy, log_prob.detach(), value.detach(), kl, clip_share)

    def _value_loss(self, value: Tensor, old: Tensor, target: Tensor) -> Tensor:
        """Half the mean of the larger squared error, of the value or of the value held close to the old one."""
        held = old + (value - old).clamp(-self.clip, self.clip)
        return 0.5 * torch.maximum((value - target).square(), (held - target).square()).mean()


def normalise(advantage: Tensor) -> Tensor:
    """Mean 0 and population standard deviation 1, over all entries; 1e-8 keeps a constant finite.

    Example:
        >>> normalise(torch.tensor([[1.0, 3.0]]))
        tensor([[-1.,  1.]])
    """
    centred = advantage - advantage.mean()
    return centred / (centred.square().mean().sqrt() + 1e-8)
