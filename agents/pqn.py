"""PQN: Q-learning with lambda-returns, no replay buffer, no target network; with memory or without."""

from dataclasses import dataclass
from typing import ClassVar

from arcade_torch.agents.learner_config import QConfig
from arcade_torch.agents.protocols import QNetwork
from arcade_torch.agents.q_loss import QLoss
from arcade_torch.agents.window import Bootstrap


@dataclass(frozen=True)
class PQNConfig(QConfig):
    """Numbers of the PQN learner; the defaults are the paper's, schedules in shares of the run's frames.

    Source: POPGym Arcade (ICML 2026), hyperparameter table of PQN; Gallici et al., arXiv 2407.04811.
    """

    GROUP: ClassVar[str] = "pqn"

    bootstrap: Bootstrap = "next"
    """``"next"``: every step is trained, the last with the observation after it; ``"last"`` (the published form): the
    last step of a window only lends its value, and is trained in the next window, as context (needs context >= 1)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        super().__post_init__()
        self._split_evenly("num_envs", self.num_envs)
        self._each(("bootstrap",), lambda x: x in ("next", "last"), "'next' or 'last'")
        self._require(
            self.bootstrap == "next" or self.context >= 1,
            "context",
            ">= 1 with bootstrap='last': the last step of a window is only trained as context of the next",
        )


class PQNLoss(QLoss):
    """The loss of PQN: targets from the very pass whose Q-values are trained.

    Source: Gallici et al., arXiv 2407.04811; POPGym Arcade (ICML 2026).
    """

    @classmethod
    def from_config(cls, network: QNetwork, config: PQNConfig) -> "PQNLoss":
        """The loss that ``config`` describes."""
        return cls(network, config.gamma, config.lam, config.time_limit, config.bootstrap)
