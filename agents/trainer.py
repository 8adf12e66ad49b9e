"""One run in memory: environments, actor, learner, and the state that makes it resumable."""

import time
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

import arcade_torch
from arcade_torch.agents.actor import EpsilonGreedyActor
from arcade_torch.agents.agent import build_network
from arcade_torch.agents.algorithms import ALGORITHMS
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.evaluation import twins
from arcade_torch.agents.learner import NonFiniteError
from arcade_torch.agents.metrics import EpisodeStats

_CALIBRATION_FRAMES = 3200


class Trainer:
    """Collects and learns, one update at a time; the same for every algorithm and memory.

    Args:
        config: of the run.
        replay_folder: where a replay writes, made when first needed; None for a temporary folder.
    """

    def __init__(self, config: TrainConfig, replay_folder: Path | None = None) -> None:
        self.config = config
        numbers, algorithm = config.learner, ALGORITHMS[config.algorithm]
        self.network = build_network(config)
        self.total_frames = config.num_updates * numbers.frames_per_update
        self.explore = torch.Generator(config.device).manual_seed(config.seed)
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        self.actor = algorithm.make_actor(self.network, self.explore)
        self.learner = algorithm.make_learner(self.network, config, self.total_frames, self.shuffle, replay_folder)
        self.env = arcade_torch.make(
            config.env,
            num_envs=numbers.num_envs,
            observability=twins(config.observability, numbers.num_envs),
            obs_size=config.obs_size,
            seed=config.seed,
            device=config.device,
            rules=config.rules,
            **dict(config.env_options),
        )
        self.collector = arcade_torch.ArcadeCollector(
            self.env,
            self.actor,
            frames_per_batch=numbers.frames_per_update,
            total_frames=-1,
            context=numbers.prefix,
            compress=self.network.compress,
            final_frames="truncated" if numbers.time_limit == "bootstrap" else "none",
        )
        self.stats = EpisodeStats.start(numbers.num_envs)
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
        numbers = self.config.learner
        steps = max(0, numbers.warmup_steps - numbers.prefix)  # the first window fills the context too
        windows = -(-steps // numbers.num_steps)
        seen: list[Tensor] = []
        self.actor.uniform = True
        for _ in range(windows):
            frames = self._new_steps(self.collector.collect().get("pixels")).flatten(0, 1)
            stride = max(1, frames.shape[0] * windows // _CALIBRATION_FRAMES)
            seen.append(frames[::stride].clone())
        self.actor.uniform = False
        if seen:
            self.network.calibrate(torch.cat(seen))

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
        last = self._follow_episodes(batch)
        try:
            metrics = self.learner.learn(batch, self.frames)
        except NonFiniteError as error:
            raise NonFiniteError(f"update {self.updates + 1} (after {self.frames} frames): {error}") from error
        self.frames += self.config.learner.frames_per_update
        self.updates += 1
        took = time.perf_counter() - began
        self.seconds += took
        finished = self.stats.finished
        return {
            "frames": self.frames,
            "updates": self.updates,
            "grad_steps": self.learner.grad_steps,
            "seconds": self.seconds,
            "fps": self.config.learner.frames_per_update / took,
            **metrics,
            "epsilon": epsilon,
            "train_return": sum(finished) / len(finished) if finished else None,
            "train_return_ewm": self.stats.smooth,
            "train_return_last": last,
            "episodes": self.stats.episodes,
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

    def _follow_episodes(self, batch: TensorDictBase) -> float:
        reward, done = batch.get(("next", "reward")), batch.get(("next", "done"))
        return self.stats.update(self._new_steps(reward).squeeze(-1), self._new_steps(done).squeeze(-1))

    def _new_steps(self, entry: Tensor) -> Tensor:
        """Without the context that the previous window already had."""
        return entry[:, entry.shape[1] - self.config.learner.num_steps :]
