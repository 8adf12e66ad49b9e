"""The algorithms by name: which network, which actor, which learner; everything else of a run is the same for all."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from arcade_torch.agents.actor import CategoricalActor, EpsilonGreedyActor
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.learner import Learner
from arcade_torch.agents.learners import DQNLearner, PPOLearner, PQNLearner
from arcade_torch.models.actor_critic import ActorCriticNetwork, make_actor_critic
from arcade_torch.models.networks import MemoryNetwork, make_network

__all__ = ["ALGORITHMS", "Algorithm", "Network"]

Network = MemoryNetwork | ActorCriticNetwork
PlayingActor = EpsilonGreedyActor | CategoricalActor


@dataclass(frozen=True)
class Algorithm:
    """What differs between algorithms.

    Attributes:
        offers: what the outputs of its network can be read as, see ``Agent.outputs``.
        make_network: with the arguments of ``make_network``.
        make_actor: ``(network, generator)``; without a generator it acts greedily.
        make_learner: ``(network, config, total_frames, generator, folder)``; only a replay needs the folder.
    """

    offers: tuple[str, ...]
    make_network: Callable[..., Network]
    make_actor: Callable[[Any, torch.Generator | None], PlayingActor]
    make_learner: Callable[[Any, TrainConfig, int, torch.Generator, Path | None], Learner]


def _epsilon_greedy(network: MemoryNetwork, generator: torch.Generator | None) -> EpsilonGreedyActor:
    greedy = generator is None
    return EpsilonGreedyActor(network, generator=generator, greedy=greedy, record_q=greedy)


def _categorical(network: ActorCriticNetwork, generator: torch.Generator | None) -> CategoricalActor:
    return CategoricalActor(network, generator, greedy=generator is None)


ALGORITHMS: dict[str, Algorithm] = {
    "pqn": Algorithm(
        ("q", "value"),
        make_network,
        _epsilon_greedy,
        lambda network, config, frames, generator, folder: PQNLearner(network, config.pqn, frames, generator),
    ),
    "ppo": Algorithm(
        ActorCriticNetwork.offers,
        make_actor_critic,
        _categorical,
        lambda network, config, frames, generator, folder: PPOLearner(network, config.ppo, frames, generator),
    ),
    "dqn": Algorithm(
        ("q", "value"),
        make_network,
        _epsilon_greedy,
        lambda network, config, frames, generator, folder: DQNLearner(network, config.dqn, frames, generator, folder),
    ),
}
