"""Numbers that all learners have, and those of the ones that explore with epsilon."""

from dataclasses import dataclass
from typing import Any, ClassVar

from arcade_torch.agents.checks import require
from arcade_torch.agents.schedules import linear
from arcade_torch.agents.targets import TimeLimit


@dataclass(frozen=True)
class LearnerConfig:
    """What PQN, PPO and DQN share; the defaults are the paper's, schedules in shares of the run's frames.

    A schedule over a share of the run keeps its shape when the run is shortened.
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
    learning_rate_share: float = 0.1
    """Share of the run's frames over which the step size falls linearly; 0 starts at the end value."""
    max_grad_norm: float = 0.5
    """Limit on the joint norm of the gradients."""
    warmup_steps: int = 0
    """Random steps of each environment before training, not counted as frames; they calibrate the input scaling."""
    time_limit: TimeLimit = "bootstrap"
    """``"bootstrap"``: a truncation keeps the value of its final frame; ``"terminal"``: it ends as a termination."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        self._each(("num_envs", "num_steps", "epochs", "minibatches"), lambda x: x >= 1, "a whole number >= 1")
        self._each(("warmup_steps",), lambda x: x >= 0, "a whole number >= 0")
        self._each(("gamma", "learning_rate_share"), lambda x: 0.0 <= x <= 1.0, "a number in [0, 1]")
        self._each(("learning_rate", "max_grad_norm"), lambda x: x > 0.0, "a number > 0")
        self._each(("learning_rate_end",), lambda x: x >= 0.0, "a number >= 0")
        self._each(("time_limit",), lambda x: x in ("bootstrap", "terminal"), "'bootstrap' or 'terminal'")

    def _each(self, names: tuple[str, ...], holds: Any, allowed: str) -> None:
        """Refuse the first of some fields that ``holds`` does not accept."""
        for name in names:
            self._require(bool(holds(getattr(self, name))), name, allowed)

    def _require(self, condition: bool, name: str, allowed: str) -> None:
        require(condition, f"{self.GROUP}.{name}", getattr(self, name), allowed)

    def _split_evenly(self, what: str, number: int) -> None:
        """Refuse minibatches that would not all hold the same number of whole sequences."""
        allowed = f"a divisor of {what}={number}: whole sequences go into a minibatch"
        self._require(number % self.minibatches == 0, "minibatches", allowed)

    @property
    def prefix(self) -> int:
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
        return linear(self.learning_rate, self.learning_rate_end, frames, self.learning_rate_share * total_frames)

    def epsilon_at(self, frames: float, total_frames: int) -> float | None:
        """Probability of a uniformly random action; None for a learner that samples its own policy."""
        return None


@dataclass(frozen=True)
class QConfig(LearnerConfig):
    """What the learners of Q-values share; at the paper's 20 M frames, the shares 0.1 and 0.4 are its 2 M frames of
    learning-rate decay and 8 M frames of exploration decay.
    """

    warmup_steps: int = 132
    """Random steps of each environment before training, not counted as frames; they calibrate the input scaling."""
    context: int = 4
    """Steps of the previous window repeated in front of the new ones; they take part in the loss again."""
    lam: float = 0.95
    """Lambda of the return, in [0, 1]."""
    epsilon_start: float = 1.0
    """Probability of a uniformly random action at the start."""
    epsilon_end: float = 0.05
    """The same after the decay."""
    epsilon_share: float = 0.4
    """Share of the run's frames over which it falls linearly."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        super().__post_init__()
        self._each(("context",), lambda x: x >= 0, "a whole number >= 0")
        shares = ("lam", "epsilon_start", "epsilon_end", "epsilon_share")
        self._each(shares, lambda x: 0.0 <= x <= 1.0, "a number in [0, 1]")
        self._require(self.context <= self.num_steps, "context", f"at most num_steps={self.num_steps}")

    @property
    def prefix(self) -> int:
        """Steps of the previous window that stand in front of the new ones."""
        return self.context

    def epsilon_at(self, frames: float, total_frames: int) -> float | None:
        """Probability of a uniformly random action after ``frames`` of ``total_frames`` frames."""
        return linear(self.epsilon_start, self.epsilon_end, frames, self.epsilon_share * total_frames)
