"""One update of PQN: minibatches of whole sequences, several epochs, and a guard against numbers that are none."""

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.optim import clip_gradients, make_optimizer, set_learning_rate
from arcade_torch.agents.pqn import PQNConfig, PQNLoss
from arcade_torch.agents.schedules import linear
from arcade_torch.models.networks import MemoryNetwork


class NonFiniteError(RuntimeError):
    """A quantity of the training became NaN or infinite."""


@dataclass(frozen=True)
class UpdateMetrics:
    """Means over the gradient steps of one update.

    Attributes:
        loss: the PQN loss.
        q_mean: Q-value of the actions taken.
        td_error: mean absolute distance to the target.
        grad_norm: norm of the gradients before clipping.
        lr: step size at the last gradient step.
    """

    loss: float
    q_mean: float
    td_error: float
    grad_norm: float
    lr: float


class PQNLearner:
    """Network, loss and optimiser.

    Args:
        network: what to train.
        config: numbers of the learner.
        total_frames: of the run, for the schedules.
        generator: CPU generator of the minibatch order.
    """

    def __init__(
        self, network: MemoryNetwork, config: PQNConfig, total_frames: int, generator: torch.Generator
    ) -> None:
        self.network, self.config, self.total_frames, self.generator = network, config, total_frames, generator
        self.loss = PQNLoss.from_config(network, config)
        self.parameters = [p for p in network.parameters() if p.requires_grad]
        self.optimizer = make_optimizer(self.parameters, config.learning_rate)
        self.grad_steps = 0

    def learning_rate(self, frames: float) -> float:
        """Step size after ``frames`` frames."""
        c = self.config
        return linear(c.learning_rate, c.learning_rate_end, frames, c.learning_rate_share * self.total_frames)

    def learn(self, batch: TensorDictBase, frames: int) -> UpdateMetrics:
        """Train on one window of sequences.

        Args:
            batch: sequences [num_envs].
            frames: frames counted before this window.

        Returns:
            Means over the gradient steps.

        Raises:
            NonFiniteError: a reward, the loss, the gradient or a weight is not finite; names the gradient step.
        """
        config = self.config
        window = self.loss.read(batch)
        records: list[Tensor] = []
        steps = config.grad_steps_per_update
        for step, rows in enumerate(self._minibatches(window.action.shape[0])):
            set_learning_rate(self.optimizer, self.learning_rate(frames + config.frames_per_update * step / steps))
            out = self.loss.compute(window.rows(rows))
            self.optimizer.zero_grad()
            out.loss.backward()
            norm = clip_gradients(self.parameters, config.max_grad_norm)
            self.optimizer.step()
            error = (out.chosen - out.target).abs().mean()
            records.append(torch.stack((out.loss.detach(), norm, out.chosen.mean(), error)))
        self.grad_steps += steps
        table = torch.stack(records).cpu()
        self._guard(window.reward, table)
        loss, norm_mean, q_mean, td_error = table.mean(0).tolist()
        return UpdateMetrics(loss, q_mean, td_error, norm_mean, self.optimizer.param_groups[0]["lr"])

    def _minibatches(self, num_rows: int) -> list[list[int]]:
        """Row numbers of every minibatch of every epoch, in the order they are used."""
        size = num_rows // self.config.minibatches
        batches: list[list[int]] = []
        for _ in range(self.config.epochs):
            order = torch.randperm(num_rows, generator=self.generator).tolist()
            batches += [order[i : i + size] for i in range(0, num_rows, size)]
        return batches

    def _guard(self, reward: Tensor, table: Tensor) -> None:
        """Look once an update, so that no gradient step waits for the device."""
        if not bool(reward.isfinite().all()):
            raise NonFiniteError("a reward is not finite")
        for step, (loss, norm, *_) in enumerate(table.tolist()):
            for name, value in (("loss", loss), ("gradient norm", norm)):
                if not math.isfinite(value):
                    raise NonFiniteError(f"the {name} is {value} at gradient step {step + 1} of {len(table)}")
        sums = torch.stack([p.detach().sum() for p in self.parameters])
        if not bool(sums.isfinite().all()):
            bad = [n for n, p in self.network.named_parameters() if not bool(p.detach().isfinite().all())]
            raise NonFiniteError(f"the weights {', '.join(bad[:3])} are not finite")
