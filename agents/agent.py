"""A trained agent: a network, the config it was trained with, and how it acts."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.actor import EpsilonGreedyActor
from arcade_torch.agents.config import TrainConfig
from arcade_torch.models.networks import MemoryNetwork, make_network


@dataclass(frozen=True)
class Agent:
    """A network that acts greedily; also an ``Actor`` that ``ArcadeCollector`` takes as its policy.

    Attributes:
        config: of the run that trained it.
        network: the Q-network, on its device.
        frames: training frames behind it.
    """

    config: TrainConfig
    network: MemoryNetwork
    frames: int = 0

    def initial_state(self, batch_size: int) -> TensorDictBase:
        """Recurrent state before the first observation, TensorDict [N]."""
        state: TensorDictBase = self.network.initial_state(batch_size)
        return state

    def act(self, obs: TensorDictBase, state: TensorDictBase) -> tuple[Tensor, dict[str, Tensor], TensorDictBase]:
        """Greedy actions.

        Args:
            obs: root entries ``pixels`` [N, ...], ``last_action`` int64 [N], ``is_init`` bool [N, 1].
            state: recurrent state, TensorDict [N].

        Returns:
            ``(action int64 [N], {"q_value": float32 [N, A]}, new state)``.
        """
        return EpsilonGreedyActor(self.network, greedy=True, record_q=True).act(obs, state)


def build_network(config: TrainConfig) -> MemoryNetwork:
    """The freshly initialised network of a config; the same seed gives the same weights, and no global draw moves.

    Args:
        config: of the run.

    Returns:
        The network, on ``config.device``.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(config.seed)
        network = make_network(
            config.network, memory=config.memory, obs_size=config.obs_size, **dict(config.network_options)
        )
    return network.to(config.device)
