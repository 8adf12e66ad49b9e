"""DQN with a replay of sequences; with memory or without."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from arcade_torch.agents.learner_config import QConfig
from arcade_torch.agents.protocols import QNetwork
from arcade_torch.agents.q_loss import QLoss
from arcade_torch.agents.targets import TimeLimit
from arcade_torch.agents.window import Window, outputs_along

Targets = Literal["recompute", "stored"]


@dataclass(frozen=True)
class DQNConfig(QConfig):
    """Numbers of the DQN learner, schedules in shares of the run's frames.

    The paper gives none; these are those of its published code, except for ``targets`` and ``time_limit``. An item of
    the replay is one environment's window: ``context + num_steps`` frames with their actions, rewards and flags, the
    recurrent state before the first of them, and the few final frames that targets need.

    Source: reference implementation of POPGym Arcade; Mnih et al., Nature 518 (2015); Kapturowski et al., "Recurrent
    experience replay in distributed reinforcement learning" (ICLR 2019), for stored states and burn-in.
    """

    GROUP: ClassVar[str] = "dqn"

    lam: float = 0.0
    """Lambda of the return, in [0, 1]; 0 is the one-step target."""
    replay_frames: int = 132_000
    """Capacity in frames (of 43,200 bytes at 128 pixels, 3,072 with the small encoder), rounded down to whole windows
    of all environments."""
    replay_ram: int = 2_000_000_000
    """Bytes; a replay that may grow beyond is kept in memory-mapped files in the run folder."""
    batch_sequences: int = 32
    """Sequences drawn in an update, without repetition; all epochs go over the same."""
    learning_starts: int = 32
    """Sequences that must be stored before learning starts."""
    burn_in: int = 0
    """First steps of a sequence that only bring the memory up to date: read, but no part of the loss."""
    targets: Targets = "recompute"
    """``"recompute"``: from present Q-values, whenever a sequence is used; ``"stored"`` (the published form): once,
    when it was collected."""
    target_every: int = 0
    """Updates between copies of the network to a target network, which then gives the next values; 0 for none."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one clear line each."""
        super().__post_init__()
        self._each(("batch_sequences", "learning_starts"), lambda x: x >= 1, "a whole number >= 1")
        self._each(("replay_ram", "burn_in", "target_every"), lambda x: x >= 0, "a whole number >= 0")
        self._split_evenly("batch_sequences", self.batch_sequences)
        length = self.context + self.num_steps
        self._require(self.burn_in < length, "burn_in", f"less than context + num_steps = {length}")
        self._each(("targets",), lambda x: x in ("recompute", "stored"), "'recompute' or 'stored'")
        stored = self.targets == "stored"
        self._require(not (stored and self.target_every), "target_every", "0 with targets='stored'")
        held, needed = self.replay_sequences, max(self.batch_sequences, self.learning_starts, self.num_envs)
        frames = -(-needed // self.num_envs) * self.num_envs * length
        self._require(held >= needed, "replay_frames", f">= {frames}, room for {needed} sequences of {length} frames")

    @property
    def replay_sequences(self) -> int:
        """Capacity in sequences: whole windows of all environments."""
        length = self.context + self.num_steps
        return self.replay_frames // (self.num_envs * length) * self.num_envs


class DQNLoss(QLoss):
    """The loss of DQN: one-step targets (or lambda-returns) of replayed sequences.

    Keys as in ``QLoss``. Sequences start from the recurrent state that was stored when they were acted.

    Args:
        network: a ``MemoryNetwork``, or any module with its ``encode``, ``remember`` and ``initial_state``.
        gamma: discount.
        lam: lambda of the return.
        time_limit: see :class:`DQNConfig`.
        targets: see :class:`DQNConfig`; ``"stored"`` reads them from ``window.extras["target"]``, float [B, L].
        burn_in: see :class:`DQNConfig`.
        target_network: gives the next values; None for the trained network itself.
    """

    def __init__(
        self,
        network: QNetwork,
        gamma: float = 0.99,
        lam: float = 0.0,
        time_limit: TimeLimit = "bootstrap",
        targets: Targets = "recompute",
        burn_in: int = 0,
        target_network: QNetwork | None = None,
    ) -> None:
        super().__init__(network, gamma, lam, time_limit)
        self.stored, self.burn_in = targets == "stored", burn_in
        self.target_network = target_network

    @classmethod
    def from_config(cls, network: QNetwork, config: DQNConfig, target_network: QNetwork | None = None) -> "DQNLoss":
        """The loss that ``config`` describes."""
        numbers = config.gamma, config.lam, config.time_limit
        return cls(network, *numbers, config.targets, config.burn_in, target_network)

    @property
    def first_trained(self) -> int:
        """Index of the first step that takes part in the loss."""
        return self.burn_in

    @torch.no_grad()
    def bootstrap_values(self, window: Window, q: Tensor) -> Tensor:
        """Best Q-value of every observation of the extended sequence, of the target network if there is one."""
        return (q if self.target_network is None else outputs_along(self.target_network, window)).amax(-1)

    @torch.no_grad()
    def targets(self, window: Window, q: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Targets of the steps: stored ones, if the window brings them, else see ``QLoss``."""
        if self.stored and "target" in window.extras:
            target = window.extras["target"][:, :steps]
            return target, torch.zeros_like(target)
        return super().targets(window, q, steps)
