"""One run in memory: environments, actor, learner, and the state that makes it resumable."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

import arcade_torch
from arcade_torch.agents.actor import EpsilonGreedyActor
from arcade_torch.agents.agent import build_network
from arcade_torch.agents.algorithms import ALGORITHMS, Network, PlayingActor
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.evaluation import twins
from arcade_torch.agents.graphs import graphed
from arcade_torch.agents.learner import NonFiniteError
from arcade_torch.agents.learner_config import LearnerConfig
from arcade_torch.agents.metrics import EpisodeStats
from arcade_torch.groups import seed_groups

_CALIBRATION_FRAMES = 3200
COMPILE_BACKEND = "inductor"
"""Of ``torch.compile``; tests take one that needs no C++ compiler."""


class Trainer:
    """Collects and learns, one update at a time; the same for every algorithm and memory.

    Args:
        config: of the run.
        replay_folder: where a replay writes, made when first needed; None for a temporary folder.
    """

    def __init__(self, config: TrainConfig, replay_folder: Path | None = None) -> None:
        self.config = config
        algorithm = ALGORITHMS[config.algorithm]
        self.network = build_network(config)
        if config.compile:
            compile_parts(self.network)
        self.total_frames = config.num_updates * config.learner.frames_per_update
        self.explore = torch.Generator(config.device).manual_seed(config.seed)
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        self.actor = algorithm.make_actor(self.network, self.explore)
        if config.cuda_graphs:
            self.actor.step = graphed(self.actor.step, config.device)
        self.learner = algorithm.make_learner(self.network, config, self.total_frames, self.shuffle, replay_folder)
        self.collector = make_collector([config], self.actor, self.network)
        self.env = self.collector.env
        self.stats = EpisodeStats.start(config.learner.num_envs)
        self.frames = self.updates = 0
        self.seconds = 0.0

    @property
    def done(self) -> bool:
        """Whether all updates were made."""
        return self.updates >= self.config.num_updates

    def epsilon(self) -> float | None:
        """Exploration at the present frame count; None where the policy itself is sampled."""
        return self.config.learner.epsilon_at(self.frames, self.total_frames)

    def warm_up(self) -> None:
        """Random play before training: fills the context and calibrates the input scaling; not counted as frames."""
        play_at_random(self.collector, self.actor, self.config.learner, [self.network])

    def update(self) -> dict[str, Any]:
        """Collect one window and learn from it.

        Returns:
            A row of ``metrics.csv``.

        Raises:
            NonFiniteError: a quantity is NaN or infinite; names the update and the quantity.
        """
        began = time.perf_counter()
        epsilon = self.epsilon()
        if isinstance(self.actor, EpsilonGreedyActor) and epsilon is not None:
            self.actor.epsilon = epsilon
        batch = self.collector.collect()
        last = follow_episodes(self.stats, batch, self.config.learner.num_steps)
        try:
            metrics = self.learner.learn(batch, self.frames)
        except NonFiniteError as error:
            raise NonFiniteError(f"update {self.updates + 1} (after {self.frames} frames): {error}") from error
        self.frames += self.config.learner.frames_per_update
        self.updates += 1
        took = time.perf_counter() - began
        self.seconds += took
        return {
            "frames": self.frames,
            "updates": self.updates,
            "grad_steps": self.learner.grad_steps,
            "seconds": self.seconds,
            "fps": self.config.learner.frames_per_update / took,
            **metrics,
            "epsilon": epsilon,
            **episode_columns(self.stats, last),
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights that the rest of the run depends on."""
        return {
            **self.learner.state_dict(),
            "explore": self.explore.get_state(),
            "shuffle": self.shuffle.get_state(),
            "collector": self.collector.state_dict(),
            "stats": self.stats.state_dict(),
            "frames": self.frames,
            "updates": self.updates,
            "seconds": self.seconds,
        }

    def load(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        """Go back to a saved moment.

        Args:
            weights: the network's ``state_dict``.
            state: from :meth:`state_dict`.

        Raises:
            CheckpointError: a file of the replay is missing or damaged.
        """
        self.learner.load_state_dict(state)
        self.network.load_state_dict(weights)
        self.explore.set_state(state["explore"])
        self.shuffle.set_state(state["shuffle"])
        self.collector.load_state_dict(state["collector"])
        self.stats = EpisodeStats.from_state_dict(state["stats"])
        self.frames, self.updates, self.seconds = state["frames"], state["updates"], state["seconds"]

    def close(self) -> None:
        """Let go of the environments."""
        self.collector.shutdown()


def compile_parts(network: Network) -> None:
    """Compile what acting and learning call of a network; its weights and their names stay as they are.

    Sizes are symbols from the start, so windows of another length need no second compilation, and a run that goes on
    after an interruption gets the same code whichever size it meets first.

    Args:
        network: changed in place.
    """
    for part in ("encode", "remember"):
        setattr(network, part, torch.compile(getattr(network, part), dynamic=True, backend=COMPILE_BACKEND))


def make_collector(configs: Sequence[TrainConfig], actor: Any, network: Network) -> arcade_torch.ArcadeCollector:
    """The collector of a run, or of several that differ in their seed alone: a group of environments for each.

    Args:
        configs: of the runs.
        actor: plays all environments.
        network: says what of a frame is stored.

    Returns:
        A collector of ``len(configs) * num_envs`` environments.
    """
    config, numbers, size = configs[0], configs[0].learner, len(configs)
    shown = twins(config.observability, numbers.num_envs)
    env = arcade_torch.make(
        config.env,
        num_envs=size * numbers.num_envs,
        observability=shown.repeat(size) if isinstance(shown, Tensor) else shown,
        obs_size=config.obs_size,
        seed=config.seed,
        device=config.device,
        rules=config.rules,
        **dict(config.env_options),
    )
    if size > 1:
        seed_groups(env, [each.seed for each in configs])
    return arcade_torch.ArcadeCollector(
        env,
        actor,
        frames_per_batch=size * numbers.frames_per_update,
        total_frames=-1,
        context=numbers.prefix,
        compress=network.compress,
        final_frames="truncated" if numbers.time_limit == "bootstrap" else "none",
    )


def play_at_random(
    collector: arcade_torch.ArcadeCollector, actor: PlayingActor, numbers: LearnerConfig, networks: Sequence[Network]
) -> None:
    """Fill the context with random play, and calibrate each network with the frames of its group of environments."""
    steps = max(0, numbers.warmup_steps - numbers.prefix)  # the first window fills the context too
    windows = -(-steps // numbers.num_steps)
    stride = max(1, numbers.frames_per_update * windows // _CALIBRATION_FRAMES)
    seen: list[list[Tensor]] = [[] for _ in networks]
    actor.uniform = True
    for _ in range(windows):
        pixels = _new_steps(collector.collect().get("pixels"), numbers.num_steps)
        for frames, group in zip(seen, pixels.chunk(len(networks)), strict=True):
            frames.append(group.flatten(0, 1)[::stride].clone())
    actor.uniform = False
    for network, frames in zip(networks, seen, strict=True):
        if frames:
            network.calibrate(torch.cat(frames))


def follow_episodes(stats: EpisodeStats, batch: TensorDictBase, num_steps: int) -> float:
    """Count the returns of a window's new steps, see ``EpisodeStats.update``."""
    reward, done = (_new_steps(batch.get(("next", key)), num_steps).squeeze(-1) for key in ("reward", "done"))
    return stats.update(reward, done)


def episode_columns(stats: EpisodeStats, last: float) -> dict[str, Any]:
    """What ``metrics.csv`` shows of the episodes; ``last`` is what :func:`follow_episodes` returned."""
    finished = stats.finished
    return {
        "train_return": sum(finished) / len(finished) if finished else None,
        "train_return_ewm": stats.smooth,
        "train_return_last": last,
        "episodes": stats.episodes,
    }


def _new_steps(entry: Tensor, num_steps: int) -> Tensor:
    """Without the context that the previous window already had."""
    return entry[:, entry.shape[1] - num_steps :]
