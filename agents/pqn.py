"""PQN: Q-learning with lambda-returns, no replay buffer, no target network; with memory or without."""

from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from arcade_torch.agents.checks import require
from arcade_torch.agents.protocols import QNetwork
from arcade_torch.agents.targets import TimeLimit, q_lambda_return
from arcade_torch.agents.window import Bootstrap, Window, WindowKeys, read_window


@dataclass(frozen=True)
class PQNConfig:
    """Numbers of the PQN learner; the defaults are the paper's, schedules in shares of the run's frames.

    A schedule over a share of the run keeps its shape when the run is shortened. At the paper's 20 M frames, 0.1 and
    0.4 are its 2 M frames of learning-rate decay and 8 M frames of exploration decay.

    Source: POPGym Arcade (ICML 2026), hyperparameter table of PQN; Gallici et al., arXiv 2407.04811.
    """

    num_envs: int = 16
    """Environments stepped together."""
    num_steps: int = 128
    """New steps of each environment per update."""
    context: int = 4
    """Steps of the previous window repeated in front of the new ones; they take part in the loss again."""
    epochs: int = 4
    """Passes over each window."""
    minibatches: int = 16
    """Parts a pass is split in, over environments, never over time; must divide ``num_envs``."""
    gamma: float = 0.99
    """Discount per step."""
    lam: float = 0.95
    """Lambda of the return, in [0, 1]."""
    learning_rate: float = 5e-5
    """Step size at the start."""
    learning_rate_end: float = 5e-7
    """Step size after the decay."""
    learning_rate_share: float = 0.1
    """Share of the run's frames over which the step size falls linearly; 0 starts at the end value."""
    max_grad_norm: float = 0.5
    """Limit on the joint norm of the gradients."""
    epsilon_start: float = 1.0
    """Probability of a uniformly random action at the start."""
    epsilon_end: float = 0.05
    """The same after the decay."""
    epsilon_share: float = 0.4
    """Share of the run's frames over which it falls linearly."""
    warmup_steps: int = 132
    """Random steps of each environment before training, not counted as frames; they calibrate the input scaling."""
    time_limit: TimeLimit = "bootstrap"
    """``"bootstrap"``: a truncation keeps the value of its final frame; ``"terminal"``: it ends as a termination."""
    bootstrap: Bootstrap = "next"
    """``"next"``: every step is trained, the last with the observation after it; ``"last"`` (the published form): the
    last step of a window only lends its value, and is trained in the next window, as context (needs context >= 1)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        for name in ("num_envs", "num_steps", "epochs", "minibatches"):
            require(getattr(self, name) >= 1, f"pqn.{name}", getattr(self, name), "a whole number >= 1")
        for name in ("context", "warmup_steps"):
            require(getattr(self, name) >= 0, f"pqn.{name}", getattr(self, name), "a whole number >= 0")
        for name in ("gamma", "lam", "epsilon_start", "epsilon_end", "learning_rate_share", "epsilon_share"):
            require(0.0 <= getattr(self, name) <= 1.0, f"pqn.{name}", getattr(self, name), "a number in [0, 1]")
        for name in ("learning_rate", "max_grad_norm"):
            require(getattr(self, name) > 0.0, f"pqn.{name}", getattr(self, name), "a number > 0")
        require(self.learning_rate_end >= 0.0, "pqn.learning_rate_end", self.learning_rate_end, "a number >= 0")
        require(
            self.num_envs % self.minibatches == 0,
            "pqn.minibatches",
            self.minibatches,
            f"a divisor of num_envs={self.num_envs}: whole sequences go into a minibatch",
        )
        require(self.context <= self.num_steps, "pqn.context", self.context, f"at most num_steps={self.num_steps}")
        limits = ("bootstrap", "terminal")
        require(self.time_limit in limits, "pqn.time_limit", self.time_limit, "'bootstrap' or 'terminal'")
        require(self.bootstrap in ("next", "last"), "pqn.bootstrap", self.bootstrap, "'next' or 'last'")
        require(
            self.bootstrap == "next" or (self.context >= 1 and self.context + self.num_steps >= 2),
            "pqn.context",
            self.context,
            ">= 1 with bootstrap='last': the last step of a window is only trained as context of the next",
        )

    @property
    def frames_per_update(self) -> int:
        """New frames one update consumes."""
        return self.num_envs * self.num_steps

    @property
    def grad_steps_per_update(self) -> int:
        """Optimiser steps one update takes."""
        return self.epochs * self.minibatches


class PQNOutput(NamedTuple):
    """What one forward pass of the loss gives; everything but ``loss`` is detached.

    ``q_value`` float [B, L, A] are the Q-values of the observations, ``chosen`` [B, S] those of the actions taken at
    the S trained steps, ``target`` [B, S] their lambda-returns, ``next_value`` [B, S] the value of each true next
    observation.
    """

    loss: Tensor
    q_value: Tensor
    chosen: Tensor
    target: Tensor
    next_value: Tensor


class PQNLoss(LossModule):
    """Half the mean squared distance of Q(s, a) to its Q(lambda) return, both from one pass with current parameters.

    In keys: ``pixels``, ``action``, ``last_action``, ``is_init``, ``("next", "reward" | "terminated" | "truncated")``,
    and

    * for sequences [B] of ``ArcadeCollector.collect()`` (or rows of them): ``initial_state``, ``next_pool``,
      ``("next", "frame_slot")``;
    * for stock TorchRL batches [B, T]: dense ``("next", "pixels")``, and the recurrent state per step under ``memory``
      (only index 0 is read; not needed where every row begins with an episode).

    Out keys: ``loss`` (scalar with gradient), ``q_mean``, ``target_mean``, ``td_error`` (mean absolute), detached.

    Rows of a batch are whole sequences; never shuffle or flatten time.

    Args:
        network: a ``MemoryNetwork``, or any module with its ``encode``, ``remember`` and ``initial_state``.
        gamma: discount.
        lam: lambda of the return.
        time_limit: see :class:`PQNConfig`.
        bootstrap: see :class:`PQNConfig`.

    Source: Gallici et al., arXiv 2407.04811; POPGym Arcade (ICML 2026).
    """

    _AcceptedKeys = WindowKeys
    default_keys = WindowKeys
    out_keys = ("loss", "q_mean", "target_mean", "td_error")

    network: QNetwork

    def __init__(
        self,
        network: QNetwork,
        gamma: float = 0.99,
        lam: float = 0.95,
        time_limit: TimeLimit = "bootstrap",
        bootstrap: Bootstrap = "next",
    ) -> None:
        super().__init__()
        self.network = network
        self.gamma, self.lam = gamma, lam
        self.time_limit, self.bootstrap = time_limit, bootstrap

    @classmethod
    def from_config(cls, network: QNetwork, config: PQNConfig) -> "PQNLoss":
        """The loss that ``config`` describes."""
        return cls(network, config.gamma, config.lam, config.time_limit, config.bootstrap)

    @property
    def functional(self) -> bool:
        """False: the network's parameters are used where they are."""
        return False

    @property
    def in_keys(self) -> list[object]:
        """Entries that every batch must hold."""
        keys = self.tensor_keys
        return [
            keys.pixels,
            keys.action,
            keys.last_action,
            keys.is_init,
            keys.reward,
            keys.terminated,
            keys.truncated,
        ]

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """There is no separate value estimator."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss and metrics of a batch, as a TensorDict of scalars.

        Args:
            tensordict: sequences [B] or a stock batch [B, T].

        Returns:
            The out keys.

        Raises:
            ValueError: a needed next observation or recurrent state is not in the batch.
        """
        out = self.compute(self.read(tensordict))
        metrics = {
            "loss": out.loss,
            "q_mean": out.chosen.mean(),
            "target_mean": out.target.mean(),
            "td_error": (out.chosen - out.target).abs().mean(),
        }
        return TensorDict(metrics, batch_size=[])

    def read(self, tensordict: TensorDictBase) -> Window:
        """Read a batch into plain tensors once; minibatches are then ``window.rows(...)``, free of TensorDict work."""
        keys = cast(WindowKeys, self.tensor_keys)
        return read_window(tensordict, keys, self.time_limit, self.bootstrap, self.network.initial_state)

    def compute(self, window: Window) -> PQNOutput:
        """The loss of a window (the fast path of the training loop).

        Args:
            window: from :meth:`read`, or rows of it.

        Returns:
            Loss and its parts.
        """
        q = self._q_values(window)
        value = q.detach().amax(-1)
        steps = window.action.shape[1] - (1 if self.bootstrap == "last" else 0)
        position = window.position[:, :steps]
        following = (position + 1).clamp_max(value.shape[1] - 1)
        next_value = value.gather(1, following)
        chosen = q.flatten(1).gather(1, position * q.shape[-1] + window.action[:, :steps])
        target = q_lambda_return(
            window.reward[:, :steps],
            next_value,
            window.terminated[:, :steps],
            window.truncated[:, :steps],
            self.gamma,
            self.lam,
            self.time_limit,
        )
        loss = 0.5 * nn.functional.mse_loss(chosen, target)
        roots = window.position.unsqueeze(-1).expand(-1, -1, q.shape[-1])
        return PQNOutput(loss, q.detach().gather(1, roots), chosen.detach(), target, next_value)

    def _q_values(self, window: Window) -> Tensor:
        """Q-values along the extended sequence, [B, L + K, A]."""
        features = self.network.encode(window.pixels)
        if window.slot.shape[1]:
            with torch.no_grad():
                inserted = self.network.encode(window.pool[window.slot])
            features = window.extend(features, inserted)
        q, _ = self.network.remember(features, window.last_action, window.is_init, window.state)
        return q
