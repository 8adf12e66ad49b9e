"""One update of any learner: minibatches of whole sequences, and a guard against numbers that are none."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from arcade_torch.agents.learner_config import LearnerConfig
from arcade_torch.agents.optim import clip_gradients, make_optimizer, set_learning_rate
from arcade_torch.agents.window import Window


class NonFiniteError(RuntimeError):
    """A quantity of the training became NaN or infinite."""


class Learner(ABC):
    """Network, loss and optimiser; a learner says where minibatches come from and what their loss is.

    Args:
        network: what to train.
        config: numbers of the learner.
        total_frames: of the run, for the schedules.
        generator: CPU generator of the minibatch order.
    """

    OPTIMIZER: ClassVar[Literal["radam", "adam"]] = "radam"

    def __init__(
        self, network: nn.Module, config: LearnerConfig, total_frames: int, generator: torch.Generator
    ) -> None:
        self.network, self.total_frames, self.generator = network, total_frames, generator
        self.numbers = config
        self.parameters = [p for p in network.parameters() if p.requires_grad]
        self.optimizer = make_optimizer(self.parameters, config.learning_rate, self.OPTIMIZER)
        self.grad_steps = 0

    @abstractmethod
    def minibatches(self, batch: TensorDictBase) -> Iterator[Window]:
        """What to train on after a window was collected, in the order of use; nothing before learning starts.

        Args:
            batch: sequences [num_envs].
        """

    @abstractmethod
    def objective(self, window: Window) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of a minibatch, and detached scalars by their column of ``metrics.csv``, always the same ones."""

    def learn(self, batch: TensorDictBase, frames: int) -> dict[str, float]:
        """Learn from one window of sequences.

        Args:
            batch: sequences [num_envs].
            frames: frames counted before this window.

        Returns:
            Means over the gradient steps, by column of ``metrics.csv``; those of the loss are absent before learning
            starts.

        Raises:
            NonFiniteError: a reward, the loss, the gradient or a weight is not finite; names the gradient step.
        """
        if not bool(batch.get(("next", "reward")).isfinite().all()):
            raise NonFiniteError("a reward is not finite")
        numbers = self.numbers
        records: list[Tensor] = []
        names: list[str] = []
        rate, steps = numbers.learning_rate_at(frames, self.total_frames), numbers.grad_steps_per_update
        for step, window in enumerate(self.minibatches(batch)):
            rate = numbers.learning_rate_at(frames + numbers.frames_per_update * step / steps, self.total_frames)
            set_learning_rate(self.optimizer, rate)
            loss, metrics = self.objective(window)
            self.optimizer.zero_grad()
            loss.backward()
            norm = clip_gradients(self.parameters, numbers.max_grad_norm)
            self.optimizer.step()
            names = ["loss", "grad_norm", *metrics]
            records.append(torch.stack((loss.detach(), norm, *metrics.values())))
        if not records:
            return {"lr": rate}
        self.grad_steps += len(records)
        table = torch.stack(records).cpu()
        guard(table, self.network)
        return dict(zip(names, table.mean(0).tolist(), strict=True)) | {"lr": rate}

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights and the generator that the coming updates depend on."""
        return {"optimizer": self.optimizer.state_dict(), "grad_steps": self.grad_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a saved moment; the weights are loaded elsewhere."""
        self.optimizer.load_state_dict(state["optimizer"])
        self.grad_steps = state["grad_steps"]

    def row_numbers(self, num_rows: int) -> list[list[int]]:
        """Row numbers of every minibatch of every epoch, in the order they are used."""
        return minibatch_rows(self.numbers, num_rows, self.generator)


def minibatch_rows(numbers: LearnerConfig, num_rows: int, generator: torch.Generator) -> list[list[int]]:
    """Row numbers of every minibatch of every epoch, in the order they are used; one draw an epoch."""
    size = num_rows // numbers.minibatches
    batches: list[list[int]] = []
    for _ in range(numbers.epochs):
        order = torch.randperm(num_rows, generator=generator).tolist()
        batches += [order[i : i + size] for i in range(0, num_rows, size)]
    return batches


def guard(table: Tensor, network: nn.Module) -> None:
    """Look for numbers that are none, once an update, so that no gradient step waits for the device.

    Args:
        table: float [gradient steps, 2 or more], losses and gradient norms first.
        network: what was trained.

    Raises:
        NonFiniteError: one of them, or a weight, is NaN or infinite.
    """
    for step, (loss, norm, *_) in enumerate(table.tolist()):
        for name, value in (("loss", loss), ("gradient norm", norm)):
            if not math.isfinite(value):
                raise NonFiniteError(f"the {name} is {value} at gradient step {step + 1} of {len(table)}")
    sums = torch.stack([p.detach().sum() for p in network.parameters() if p.requires_grad])
    if not bool(sums.isfinite().all()):
        bad = [n for n, p in network.named_parameters() if not bool(p.detach().isfinite().all())]
        raise NonFiniteError(f"the weights {', '.join(bad[:3])} are not finite")
