"""Several seeds of one setting in memory: one batch of environments, one pass, and the state of each seed's run."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from arcade_torch.agents.actor import GroupedEpsilonGreedyActor
from arcade_torch.agents.agent import build_network
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.learner import NonFiniteError
from arcade_torch.agents.metrics import EpisodeStats
from arcade_torch.agents.seed_learner import SeedLearner
from arcade_torch.agents.trainer import episode_columns, follow_episodes, make_collector, play_at_random
from arcade_torch.groups import join_collector_states, split_collector_state
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.models.stacked import StackedNetworks


class SeedLane:
    """What belongs to one seed alone; to the loop of a run it looks like a ``Trainer`` of that seed.

    Args:
        config: of the run.
        group: what moves it.
    """

    def __init__(self, config: TrainConfig, group: "SeedTrainer") -> None:
        network = build_network(config)
        assert isinstance(network, MemoryNetwork)
        self.config, self.network, self._group = config, network, group
        self.explore = torch.Generator(config.device).manual_seed(config.seed)
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        self.stats = EpisodeStats.start(config.learner.num_envs)
        self.total_frames = config.num_updates * config.learner.frames_per_update
        self.frames = self.updates = 0
        self.seconds = 0.0
        self.row: dict[str, Any] = {}

    @property
    def done(self) -> bool:
        """Whether all updates were made."""
        return self.updates >= self.config.num_updates

    def update(self) -> dict[str, Any]:
        """The row of ``metrics.csv`` of the update that the group has just made."""
        return self.row

    def state_dict(self) -> dict[str, Any]:
        """What the state of a ``Trainer`` of this seed would be."""
        return self._group.state_dict(self)


class SeedTrainer:
    """Collects and learns for several seeds of one setting of PQN, one update of each at a time.

    Every seed has its own environments, draws, minibatches and gradient limit, so that its numbers are those of a run
    alone up to the rounding of sums that are taken in another order.

    Args:
        config: of the runs; its seed is not looked at.
        seeds: one a run.

    Raises:
        ValueError: the game, the memory model or the network does not exist, or the memory model cannot be stacked.
    """

    def __init__(self, config: TrainConfig, seeds: Sequence[int]) -> None:
        self.config, numbers = config, config.pqn
        self.lanes = [SeedLane(dataclasses.replace(config, seed=seed), self) for seed in seeds]
        self.networks = [lane.network for lane in self.lanes]
        try:
            stack = StackedNetworks(self.networks)
        except ValueError as error:
            raise ValueError(f"memory {config.memory!r}: {error}") from error
        self.actor = GroupedEpsilonGreedyActor(stack, [lane.explore for lane in self.lanes])
        shuffles = [lane.shuffle for lane in self.lanes]
        self.learner = SeedLearner(stack, self.networks, seeds, numbers, self.lanes[0].total_frames, shuffles)
        self.collector = make_collector([lane.config for lane in self.lanes], self.actor, self.networks[0])
        self._collector_states: tuple[int, list[dict[str, Any]]] | None = None

    @property
    def done(self) -> bool:
        """Whether all updates were made."""
        return self.lanes[0].done

    def warm_up(self) -> None:
        """Random play before training, see ``Trainer.warm_up``."""
        play_at_random(self.collector, self.actor, self.config.pqn, self.networks)

    def update(self) -> None:
        """Collect one window of every seed and learn from it; the lanes then hold their rows of ``metrics.csv``.

        ``seconds`` and the rate of frames share the time evenly: added up over the seeds they are the time spent.

        Raises:
            NonFiniteError: a quantity is NaN or infinite; names the update, the seed and the quantity.
        """
        began = time.perf_counter()
        numbers, first, size = self.config.pqn, self.lanes[0], len(self.lanes)
        epsilon = numbers.epsilon_at(first.frames, first.total_frames)
        assert epsilon is not None
        self.actor.epsilon = epsilon
        batch = self.collector.collect()
        groups = batch.split(numbers.num_envs)
        lasts = [follow_episodes(lane.stats, g, numbers.num_steps) for lane, g in zip(self.lanes, groups, strict=True)]
        try:
            metrics = self.learner.learn(batch, first.frames)
        except NonFiniteError as error:
            raise NonFiniteError(f"update {first.updates + 1} (after {first.frames} frames): {error}") from error
        took = (time.perf_counter() - began) / size
        for lane, last, columns in zip(self.lanes, lasts, metrics, strict=True):
            lane.frames += numbers.frames_per_update
            lane.updates += 1
            lane.seconds += took
            lane.row = {
                "frames": lane.frames,
                "updates": lane.updates,
                "grad_steps": self.learner.grad_steps,
                "seconds": lane.seconds,
                "fps": numbers.frames_per_update / took,
                **columns,
                "epsilon": epsilon,
                **episode_columns(lane.stats, last),
            }

    def state_dict(self, lane: SeedLane) -> dict[str, Any]:
        """Everything but the weights that the rest of one seed's run depends on, as ``Trainer.state_dict``."""
        index = self.lanes.index(lane)
        if self._collector_states is None or self._collector_states[0] != lane.frames:
            whole = self.collector.state_dict()
            self._collector_states = lane.frames, split_collector_state(whole, len(self.lanes))
        return {
            **self.learner.state_dict(index),
            "explore": lane.explore.get_state(),
            "shuffle": lane.shuffle.get_state(),
            "collector": self._collector_states[1][index],
            "stats": lane.stats.state_dict(),
            "frames": lane.frames,
            "updates": lane.updates,
            "seconds": lane.seconds,
        }

    def load(self, weights: Sequence[dict[str, Tensor]], states: Sequence[dict[str, Any]]) -> None:
        """Go back to a saved moment.

        Args:
            weights: for each seed the network's ``state_dict``.
            states: for each seed what ``state_dict`` gave, here or from a ``Trainer`` of that seed alone.

        Raises:
            ValueError: the states are not of one moment.
        """
        self.learner.load_state_dicts(states)
        self.collector.load_state_dict(join_collector_states([state["collector"] for state in states]))
        self._collector_states = None
        for lane, weight, state in zip(self.lanes, weights, states, strict=True):
            lane.network.load_state_dict(weight)
            lane.explore.set_state(state["explore"])
            lane.shuffle.set_state(state["shuffle"])
            lane.stats = EpisodeStats.from_state_dict(state["stats"])
            lane.frames, lane.updates, lane.seconds = state["frames"], state["updates"], state["seconds"]

    def close(self) -> None:
        """Let go of the environments."""
        self.collector.shutdown()
