"""What PQN, PPO and DQN share: their numbers, the optimiser, the order of minibatches, the check for NaN."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args, get_origin, get_type_hints

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule
from torch import Tensor, nn
from torchrl.objectives import LossModule

TimeLimit = Literal["bootstrap", "terminal"]


def require(condition: bool, name: str, value: Any, allowed: str) -> None:
    """Refuse a value with one line that names it and says what is allowed.

    Raises:
        ValueError: ``condition`` does not hold.

    Example:
        >>> require(0 >= 1, "epochs", 0, "a whole number >= 1")
        Traceback (most recent call last):
        ...
        ValueError: epochs must be a whole number >= 1; got 0
    """
    if not condition:
        found = " ".join(line.strip() for line in repr(value).splitlines())
        raise ValueError(f"{name} must be {allowed}; got {found}")


def linear(start: float, end: float, frames: float, duration: float) -> float:
    """Straight line from ``start`` at frame 0 to ``end`` at frame ``duration``, constant afterwards.

    Example:
        >>> [linear(1.0, 0.0, frames, 100) for frames in (0, 25, 100, 1000)]
        [1.0, 0.75, 0.0, 0.0]
    """
    return end if frames >= duration else start + (end - start) * (frames / duration)


class NonFiniteError(RuntimeError):
    """A quantity of the training became NaN or infinite."""


def coerce(name: str, value: Any, kind: Any) -> Any:
    """The value of a field of a type; whole floats become ints.

    Raises:
        ValueError: the value is of another type.
    """
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        allowed = " or ".join(filter(None, (", ".join(map(repr, choices[:-1])), repr(choices[-1]))))
        require(isinstance(value, str) and value in choices, name, value, allowed)
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        require(number and value == value // 1, name, value, "a whole number")
        return int(value)
    if kind is float:
        require((number and abs(value) < 2.0**1000) or value != value, name, value, "a number")
        return float(value)
    words = {str: "a string", bool: "true or false", Mapping: "a mapping of option names to values"}
    base = get_origin(kind) or kind
    require(isinstance(value, base), name, value, words.get(kind) or words.get(base) or f"a {base.__name__}")
    return value


@dataclass(frozen=True)
class Checked:
    """A frozen dataclass whose fields are checked by their annotations, with one clear line for what does not fit."""

    GROUP: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Refuse values of another type."""
        hints = get_type_hints(type(self))
        for field in fields(self):
            value = coerce(self._named(field.name), getattr(self, field.name), hints[field.name])
            object.__setattr__(self, field.name, value)

    def _named(self, name: str) -> str:
        return f"{self.GROUP}.{name}" if self.GROUP else name

    def _each(self, names: tuple[str, ...], holds: Any, allowed: str) -> None:
        """Refuse the first of some fields that ``holds`` does not accept."""
        for name in names:
            self._require(bool(holds(getattr(self, name))), name, allowed)

    def _require(self, condition: bool, name: str, allowed: str) -> None:
        require(condition, self._named(name), getattr(self, name), allowed)


@dataclass(frozen=True)
class LearnerConfig(Checked):
    """What PQN, PPO and DQN share; the defaults are the paper's, schedules in fractions of the run's frames.

    A schedule over a fraction of the run keeps its shape when the run is shortened.
    """

    GROUP: ClassVar[str] = "learner"

    num_envs: int = 16
    """Environments stepped together."""
    num_steps: int = 128
    """New steps of each environment per update."""
    epochs: int = 4
    """Passes over the data of an update."""
    minibatches: int = 16
    """Parts a pass is split in, over sequences, never over time."""
    gamma: float = 0.99
    """Discount per step."""
    learning_rate: float = 5e-5
    """Step size at the start."""
    learning_rate_end: float = 5e-7
    """Step size after the decay."""
    lr_decay_fraction: float = 0.1
    """Fraction of the run's frames over which the step size falls linearly; 0 starts at the end value."""
    max_grad_norm: float = 0.5
    """Limit on the joint norm of the gradients."""
    warmup_steps: int = 0
    """Random steps of each environment before training, not counted as frames; they calibrate the input scaling."""
    time_limit: TimeLimit = "bootstrap"
    """``"bootstrap"``: a truncation keeps the value of its final frame; ``"terminal"``: it ends as a termination."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        super().__post_init__()
        self._each(("num_envs", "num_steps", "epochs", "minibatches"), lambda x: x >= 1, "a whole number >= 1")
        self._each(("warmup_steps",), lambda x: x >= 0, "a whole number >= 0")
        self._each(("gamma", "lr_decay_fraction"), lambda x: 0.0 <= x <= 1.0, "a number in [0, 1]")
        self._each(("learning_rate", "max_grad_norm"), lambda x: x > 0.0, "a number > 0")
        self._each(("learning_rate_end",), lambda x: x >= 0.0, "a number >= 0")

    def _split_evenly(self, what: str, number: int) -> None:
        """Refuse minibatches that would not all hold the same number of whole sequences."""
        allowed = f"a divisor of {what}={number}: whole sequences go into a minibatch"
        self._require(number % self.minibatches == 0, "minibatches", allowed)

    @property
    def steps_before(self) -> int:
        """Steps of the previous window that stand in front of the new ones."""
        return 0

    @property
    def frames_per_update(self) -> int:
        """New frames one update consumes."""
        return self.num_envs * self.num_steps

    @property
    def grad_steps_per_update(self) -> int:
        """Optimiser steps one update takes."""
        return self.epochs * self.minibatches

    def learning_rate_at(self, frames: float, total_frames: int) -> float:
        """Step size after ``frames`` of ``total_frames`` frames."""
        return linear(self.learning_rate, self.learning_rate_end, frames, self.lr_decay_fraction * total_frames)

    def epsilon_at(self, frames: float, total_frames: int) -> float | None:
        """Probability of a uniformly random action; None for a learner that samples its own policy."""
        return None


@dataclass(frozen=True)
class QConfig(LearnerConfig):
    """What the learners of Q-values share; at the paper's 20 M frames, the fractions 0.1 and 0.4 are its 2 M frames of
    learning-rate decay and 8 M frames of exploration decay.
    """

    warmup_steps: int = 132
    """Random steps of each environment before training, not counted as frames; they calibrate the input scaling."""
    overlap: int = 4
    """Steps of the previous window repeated in front of the new ones; they take part in the loss again."""
    lam: float = 0.95
    """Lambda of the return, in [0, 1]."""
    epsilon_start: float = 1.0
    """Probability of a uniformly random action at the start."""
    epsilon_end: float = 0.05
    """The same after the decay."""
    exploration_fraction: float = 0.4
    """Fraction of the run's frames over which it falls linearly."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        super().__post_init__()
        self._each(("overlap",), lambda x: x >= 0, "a whole number >= 0")
        fractions = ("lam", "epsilon_start", "epsilon_end", "exploration_fraction")
        self._each(fractions, lambda x: 0.0 <= x <= 1.0, "a number in [0, 1]")
        self._require(self.overlap <= self.num_steps, "overlap", f"at most num_steps={self.num_steps}")

    @property
    def steps_before(self) -> int:
        """Steps of the previous window that stand in front of the new ones."""
        return self.overlap

    def epsilon_at(self, frames: float, total_frames: int) -> float | None:
        """Probability of a uniformly random action after ``frames`` of ``total_frames`` frames."""
        return linear(self.epsilon_start, self.epsilon_end, frames, self.exploration_fraction * total_frames)


@dataclass(frozen=True)
class Training:
    """What a learner needs to know of its run.

    Attributes:
        total_frames: of the run, for the schedules.
        generator: CPU generator of the minibatch order.
        device: of the networks.
        folder: where a replay may write; None for a temporary folder.
        cuda_graphs: capture the gradient step as one CUDA graph.
    """

    total_frames: int
    generator: torch.Generator
    device: torch.device
    folder: Path | None = None
    cuda_graphs: bool = False


class Learner:
    """The plumbing below an algorithm's ``update``: one gradient step, minibatches, schedules, the check for NaN.

    Args:
        loss: gives a TensorDict; the sum of its ``loss*`` entries is minimised, all its scalars become metrics.
        config: numbers of the algorithm.
        training: of the run.
        optimizer: ``"radam"`` or ``"adam"``, see :func:`make_optimizer`.
    """

    def __init__(
        self, loss: LossModule, config: LearnerConfig, training: Training, optimizer: Literal["radam", "adam"]
    ) -> None:
        self.loss, self.config, self.training = loss, config, training
        self.parameters = [p for p in loss.parameters() if p.requires_grad]
        self.optimizer = make_optimizer(self.parameters, config.learning_rate, optimizer)
        self.grad_steps = 0
        self.learning_rate = config.learning_rate
        self._step = CudaGraphModule(self._plain_step) if training.cuda_graphs else self._plain_step
        self._metrics: list[TensorDictBase] = []

    def minibatches(self, num_rows: int) -> Iterator[Tensor]:
        """Row numbers int64 of the minibatches of one pass, in random order; they are on the device."""
        order = torch.randperm(num_rows, generator=self.training.generator)
        yield from order.to(self.training.device, non_blocking=True).chunk(self.config.minibatches)

    def gradient_step(self, minibatch: TensorDictBase, frames: float) -> None:
        """One step of the optimiser, with the step size after ``frames`` frames."""
        self.learning_rate = self.config.learning_rate_at(frames, self.training.total_frames)
        set_learning_rate(self.optimizer, self.learning_rate)
        self._metrics.append(self._step(minibatch))

    def _plain_step(self, minibatch: TensorDictBase) -> TensorDictBase:
        losses = self.loss(minibatch)
        loss = sum(value for key, value in losses.items() if key.startswith("loss"))
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm, foreach=True)
        self.optimizer.step()
        metrics = {key: value.detach().mean() for key, value in losses.items()}
        return TensorDict(metrics | {"loss": loss.detach(), "grad_norm": norm}, batch_size=[])

    def take_metrics(self) -> dict[str, float]:
        """Means over the gradient steps since the last call, read from the device once.

        Raises:
            NonFiniteError: a loss, a gradient or a weight is not finite; names the gradient step.
        """
        steps, self._metrics = self._metrics, []
        if not steps:
            return {"lr": self.learning_rate}
        self.grad_steps += len(steps)
        names = list(steps[0].keys())
        table = torch.stack([torch.stack([step[name] for name in names]) for step in steps]).tolist()
        for number, row in enumerate(table):
            for name, text in (("loss", "loss"), ("grad_norm", "gradient norm")):
                if not math.isfinite(value := row[names.index(name)]):
                    raise NonFiniteError(f"the {text} is {value} at gradient step {number + 1} of {len(table)}")
        if not bool(torch.stack([p.detach().sum() for p in self.parameters]).isfinite().all()):
            bad = [n for n, p in self.loss.named_parameters() if not bool(p.detach().isfinite().all())]
            raise NonFiniteError(f"the weights {', '.join(bad[:3])} are not finite")
        means = {name: sum(column) / len(table) for name, column in zip(names, zip(*table, strict=True), strict=True)}
        return means | {"lr": self.learning_rate}

    def check_rewards(self, batch: TensorDictBase) -> None:
        """Refuse rewards that are not finite before anything is learned from them.

        Raises:
            NonFiniteError: one is not.
        """
        if not bool(batch.get(("next", "reward")).isfinite().all()):
            raise NonFiniteError("a reward is not finite")

    def update(self, batch: TensorDictBase, frames: float) -> Any:
        """Learn from one window of sequences; see the algorithms."""
        raise NotImplementedError

    def state_dict(self) -> dict[str, Any]:
        """Everything but the trained weights and the generator that the coming updates depend on."""
        return {"optimizer": self.optimizer.state_dict(), "grad_steps": self.grad_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a saved moment; the weights are loaded elsewhere."""
        rates = [group["lr"] for group in self.optimizer.param_groups]
        self.optimizer.load_state_dict(state["optimizer"])
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate  # set before every step; on CUDA a tensor, which a checkpoint would put on the CPU
        self.grad_steps = state["grad_steps"]


def make_optimizer(
    parameters: list[nn.Parameter], learning_rate: float, kind: Literal["radam", "adam"] = "radam"
) -> torch.optim.Optimizer:
    """RAdam (PQN, DQN; eps 1e-8) or Adam (PPO; eps 1e-5) with the constants of the paper: betas 0.9, 0.999, no decay.

    Args:
        parameters: what to train.
        learning_rate: initial step size; :func:`set_learning_rate` moves it.
        kind: which of the two.

    Returns:
        The optimiser, multi-tensor; on CUDA with a step size that a graph can read.

    Source: Liu et al., "On the variance of the adaptive learning rate and beyond", arXiv 1908.03265;
    Kingma & Ba, arXiv 1412.6980.
    """
    cuda = bool(parameters) and parameters[0].device.type == "cuda"
    lr = torch.tensor(learning_rate, device=parameters[0].device) if cuda else learning_rate
    if kind == "adam":
        return torch.optim.Adam(parameters, lr=lr, betas=(0.9, 0.999), eps=1e-5, foreach=True, capturable=cuda)
    return torch.optim.RAdam(parameters, lr=lr, betas=(0.9, 0.999), eps=1e-8, foreach=True, capturable=cuda)


def set_learning_rate(optimizer: torch.optim.Optimizer, learning_rate: float) -> None:
    """Give every parameter group the same step size; in place where it is a tensor."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(learning_rate)
        else:
            group["lr"] = learning_rate
