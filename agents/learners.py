"""The learners of PQN, PPO and DQN: where minibatches come from, and their loss."""

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.dqn import DQNConfig, DQNLoss
from arcade_torch.agents.learner import Learner
from arcade_torch.agents.ppo import PPOConfig, PPOLoss
from arcade_torch.agents.pqn import PQNConfig, PQNLoss
from arcade_torch.agents.q_loss import QLoss
from arcade_torch.agents.replay import SequenceReplay
from arcade_torch.agents.window import Window
from arcade_torch.models.actor_critic import ActorCriticNetwork
from arcade_torch.models.networks import MemoryNetwork


def _q_objective(loss: QLoss, window: Window) -> tuple[Tensor, dict[str, Tensor]]:
    out = loss.compute(window)
    error = (out.chosen - out.target).abs().mean()
    return out.loss, {"q_mean": out.chosen.mean(), "td_error": error}


class PQNLearner(Learner):
    """Every window is used for some epochs, then forgotten. Arguments: see ``Learner``."""

    def __init__(
        self, network: MemoryNetwork, config: PQNConfig, total_frames: int, generator: torch.Generator
    ) -> None:
        super().__init__(network, config, total_frames, generator)
        self.loss = PQNLoss.from_config(network, config)

    def minibatches(self, batch: TensorDictBase) -> Iterator[Window]:
        """Rows of the window."""
        window = self.loss.read(batch)
        for rows in self.row_numbers(window.action.shape[0]):
            yield window.rows(rows)

    def objective(self, window: Window) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss, and what ``metrics.csv`` shows of it."""
        return _q_objective(self.loss, window)


class PPOLearner(Learner):
    """Advantages once a window, then some epochs over it. Arguments: see ``Learner``."""

    OPTIMIZER: ClassVar[Literal["radam", "adam"]] = "adam"

    def __init__(
        self, network: ActorCriticNetwork, config: PPOConfig, total_frames: int, generator: torch.Generator
    ) -> None:
        super().__init__(network, config, total_frames, generator)
        self.loss = PPOLoss.from_config(network, config)

    def minibatches(self, batch: TensorDictBase) -> Iterator[Window]:
        """Rows of the window, with their advantages."""
        window = self.loss.read(batch)
        num_rows = window.action.shape[0]
        window = self.loss.prepare(window, rows_at_once=num_rows // self.numbers.minibatches)
        for rows in self.row_numbers(num_rows):
            yield window.rows(rows)

    def objective(self, window: Window) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss, and what ``metrics.csv`` shows of it."""
        out = self.loss.compute(window)
        return out.loss, {
            "q_mean": out.state_value.mean(),
            "td_error": (out.state_value - window.extras["value_target"]).abs().mean(),
            "policy_loss": out.policy.detach(),
            "value_loss": out.value.detach(),
            "entropy": out.entropy.detach(),
            "kl": out.kl,
            "clip_share": out.clip_share,
        }


class DQNLearner(Learner):
    """Every window goes into the replay, an update goes over sequences drawn from it.

    Args:
        network: what to train.
        config: numbers of the learner.
        total_frames: of the run, for the schedules.
        generator: CPU generator of the draws and the minibatch order.
        folder: of the replay; None for a temporary one.
    """

    def __init__(
        self,
        network: MemoryNetwork,
        config: DQNConfig,
        total_frames: int,
        generator: torch.Generator,
        folder: Path | None = None,
    ) -> None:
        super().__init__(network, config, total_frames, generator)
        self.config, self.q_network = config, network
        self.target = copy.deepcopy(network).requires_grad_(False) if config.target_every else None
        self.loss = DQNLoss.from_config(network, config, self.target)
        self.replay = SequenceReplay(config.replay_sequences, folder, config.replay_ram)
        self.updates = 0

    def minibatches(self, batch: TensorDictBase) -> Iterator[Window]:
        """Rows of sequences drawn from the replay, into which the window goes first; none before learning starts."""
        self._store(batch)
        if len(self.replay) < max(self.config.learning_starts, self.config.batch_sequences):
            return
        if self.target is not None and self.updates % self.config.target_every == 0:
            self.target.load_state_dict(self.q_network.state_dict())
        self.updates += 1
        window = self._drawn()
        for rows in self.row_numbers(self.config.batch_sequences):
            yield window.rows(rows)

    def objective(self, window: Window) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss, and what ``metrics.csv`` shows of it."""
        return _q_objective(self.loss, window)

    def learn(self, batch: TensorDictBase, frames: int) -> dict[str, float]:
        """See ``Learner.learn``; adds what the replay holds."""
        return super().learn(batch, frames) | {"replay_frames": self.replay.frames}

    def _store(self, batch: TensorDictBase) -> None:
        extras = {}
        if self.loss.stored:
            window = self.loss.read(batch)
            with torch.no_grad():
                targets = [self.loss.compute(window.rows([row])).target for row in range(window.action.shape[0])]
            extras["target"] = torch.cat(targets)
        self.replay.add(batch, **extras)

    def _drawn(self) -> Window:
        """A batch of the replay as a window."""
        count, device = self.config.batch_sequences, self.parameters[0].device
        drawn = self.replay.sample(count, self.generator, device)
        state = self.q_network.initial_state(count)  # has the entries without tensors as well
        stored = drawn["initial_state"]
        for key in stored.keys(True, True):
            state[key] = stored[key]
        window = self.loss.read(drawn.set("initial_state", state))
        if not self.loss.stored:
            return window
        return window.roots().with_extras(target=drawn["extras", "target"])

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights and the generator that the coming updates depend on."""
        more: dict[str, Any] = {"replay": self.replay.state_dict(), "learner_updates": self.updates}
        if self.target is not None:
            more["target"] = dict(self.target.state_dict())
        return super().state_dict() | more

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a saved moment.

        Raises:
            CheckpointError: a file of the replay is missing or damaged.
        """
        self.replay.load_state_dict(state["replay"])
        super().load_state_dict(state)
        self.updates = state["learner_updates"]
        if self.target is not None:
            self.target.load_state_dict(state["target"])
