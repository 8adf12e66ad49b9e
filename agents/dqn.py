"""DQN with a replay of sequences; with memory or without."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import ValueEstimatorBase

from arcade_torch.agents.config import DQNConfig
from arcade_torch.agents.layout import insert_final_observations, unroll
from arcade_torch.agents.learner import Learner, Training
from arcade_torch.agents.pqn import PQNLoss
from arcade_torch.agents.replay import SequenceReplay


class DQNLoss(PQNLoss):
    """The loss of DQN: one-step targets (or lambda-returns) of replayed sequences, with or without
    a target network.

    Keys and arguments as in :class:`PQNLoss`, but ``lmbda`` of :meth:`make_value_estimator` is 0 by
    default; where a batch holds ``stored_target`` [N, L], these are the targets. Sequences, and
    their burn-in, start from their stored state; with ``store="step"`` every step that has
    ``is_init`` set starts from the state stored there.
    """

    def make_value_estimator(
        self, value_type: ValueEstimators | ValueEstimatorBase | None = None, **hyperparams: Any
    ) -> None:
        """Choose how targets are made.

        Args:
            value_type: as in :class:`PQNLoss`.
            **hyperparams: ``gamma`` (0.99) and ``lmbda`` (0).
        """
        if value_type is None:
            hyperparams = {"lmbda": 0.0} | hyperparams
        super().make_value_estimator(value_type, **hyperparams)

    @torch.no_grad()
    def targets(self, data: TensorDictBase, q: Tensor, steps: int) -> Tensor:
        """Stored targets, if the batch brings them, else see :meth:`PQNLoss.targets`."""
        stored = data.get("stored_target", None)
        return super().targets(data, q, steps) if stored is None else stored[:, :steps]


class CopyToTarget(TargetNetUpdater):
    """Copies the network to the target network, buffers included, which TorchRL's ``HardUpdate``
    leaves out: the scaling of the input is one.
    """

    def step(self) -> None:
        """Copy once."""
        loss = self.loss_module
        loss.target_value_network_params.data.update_(loss.value_network_params.data)


class DQN(Learner):
    """Puts every window into the replay and learns from sequences drawn from it; arguments as in
    :class:`PQN`.
    """

    config: DQNConfig
    loss: DQNLoss

    def __init__(
        self, network: TensorDictModuleBase, config: DQNConfig, training: Training
    ) -> None:
        has_target = config.target_every > 0
        loss = DQNLoss(
            network,
            time_limit=config.time_limit,
            burn_in=config.burn_in,
            delay_value=has_target,
            functional=has_target,
        )
        loss.make_value_estimator(gamma=config.gamma, lmbda=config.lam)
        super().__init__(loss, config, training, optimizer="radam")
        self.copy_to_target = CopyToTarget(loss) if has_target else None
        self.replay = SequenceReplay(config.replay_sequences, training.folder)
        self.updates = 0

    def update(self, batch: TensorDictBase, frames: float) -> dict[str, float]:
        """Store one window and learn from sequences drawn from the replay, once it holds enough;
        see `PQN.update`.
        """
        config = self.config
        if config.targets == "stored":
            batch = batch.copy().set("stored_target", self._present_targets(batch))
        self.replay.add(batch)
        if len(self.replay) >= max(config.learning_starts, config.batch_sequences):
            if self.copy_to_target is not None and self.updates % config.target_every == 0:
                self.copy_to_target.step()
            self.updates += 1
            drawn = self.replay.sample(
                config.batch_sequences, self.training.generator, self.training.device
            )
            data = self.loss.prepare(drawn)
            for minibatch in self.minibatches(data):
                self.gradient_step(minibatch, frames)
                frames += self.frames_per_step
        return self.take_metrics() | {"replay_frames": self.replay.frames}

    @torch.no_grad()
    def _present_targets(self, batch: TensorDictBase) -> Tensor:
        """Targets float [N, L] by the present network, row by row to bound memory.

        Whole sequences: a burn-in is part of the loss alone.
        """
        inputs = self.loss.inputs
        data = insert_final_observations(batch, inputs, self.loss.time_limit)
        targets = []
        for row in data.split(1):
            q = unroll(self.loss.value_network, inputs, row, "action_value")
            targets.append(self.loss.targets(row, q, row["reward"].shape[1]))
        return torch.cat(targets)

    def state_dict(self) -> dict[str, Any]:
        """Everything but the trained weights and the generator that the coming updates depend
        on.
        """
        more: dict[str, Any] = {"replay": self.replay.state_dict(), "learner_updates": self.updates}
        if self.config.target_every:
            target = self.loss.target_value_network_params.flatten_keys(".")
            more["target"] = {key: value.clone() for key, value in target.items()}
        return super().state_dict() | more

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a saved moment; a ``CheckpointError`` if a file of the replay is missing or
        damaged.
        """
        self.replay.load_state_dict(state["replay"])
        super().load_state_dict(state)
        self.updates = state["learner_updates"]
        if self.config.target_every:
            target = TensorDict(state["target"]).unflatten_keys(".")
            self.loss.target_value_network_params.data.update_(target)
