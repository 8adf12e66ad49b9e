"""One PQN run in memory: environments, actor, learner, and the state that makes it resumable."""

import time
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

import arcade_torch
from arcade_torch.agents.actor import EpsilonGreedyActor
from arcade_torch.agents.agent import build_network
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.learner import NonFiniteError, PQNLearner
from arcade_torch.agents.metrics import EpisodeStats
from arcade_torch.agents.schedules import linear

_CALIBRATION_FRAMES = 3200


class Trainer:
    """Collects and learns, one update at a time.

    Args:
        config: of the run.
    """

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        pqn = config.pqn
        self.network = build_network(config)
        self.total_frames = config.num_updates * pqn.frames_per_update
        self.explore = torch.Generator(config.device).manual_seed(config.seed)
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        self.actor = EpsilonGreedyActor(self.network, 1.0, self.explore)
        self.learner = PQNLearner(self.network, pqn, self.total_frames, self.shuffle)
        self.env = arcade_torch.make(
            config.env,
            num_envs=pqn.num_envs,
            observability=config.observability,
            obs_size=config.obs_size,
            seed=config.seed,
            device=config.device,
            rules=config.rules,
            **dict(config.env_options),
        )
        self.collector = arcade_torch.ArcadeCollector(
            self.env,
            self.actor,
            frames_per_batch=pqn.frames_per_update,
            total_frames=-1,
            context=pqn.context,
            compress=self.network.compress,
            final_frames="truncated" if pqn.time_limit == "bootstrap" else "none",
        )
        self.stats = EpisodeStats.start(pqn.num_envs)
        self.frames = self.updates = 0
        self.seconds = 0.0

    @property
    def done(self) -> bool:
        """Whether all updates were made."""
        return self.updates >= self.config.num_updates

    def epsilon(self) -> float:
        """Exploration at the present frame count."""
        pqn = self.config.pqn
        return linear(pqn.epsilon_start, pqn.epsilon_end, self.frames, pqn.epsilon_share * self.total_frames)

    def warm_up(self) -> None:
        """Random play before training: fills the context and calibrates the input scaling; not counted as frames."""
        pqn = self.config.pqn
        windows = -(-max(0, pqn.warmup_steps - pqn.context) // pqn.num_steps)  # the first one fills the context too
        self.actor.epsilon = 1.0
        seen: list[Tensor] = []
        for _ in range(windows):
            frames = self._new_steps(self.collector.collect().get("pixels")).flatten(0, 1)
            stride = max(1, frames.shape[0] * windows // _CALIBRATION_FRAMES)
            seen.append(frames[::stride].clone())
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
        self.actor.epsilon = epsilon = self.epsilon()
        batch = self.collector.collect()
        last = self._follow_episodes(batch)
        try:
            metrics = self.learner.learn(batch, self.frames)
        except NonFiniteError as error:
            raise NonFiniteError(f"update {self.updates + 1} (after {self.frames} frames): {error}") from error
        self.frames += self.config.pqn.frames_per_update
        self.updates += 1
        took = time.perf_counter() - began
        self.seconds += took
        finished = self.stats.finished
        return {
            "frames": self.frames,
            "updates": self.updates,
            "grad_steps": self.learner.grad_steps,
            "seconds": self.seconds,
            "fps": self.config.pqn.frames_per_update / took,
            "loss": metrics.loss,
            "q_mean": metrics.q_mean,
            "td_error": metrics.td_error,
            "grad_norm": metrics.grad_norm,
            "epsilon": epsilon,
            "lr": metrics.lr,
            "train_return": sum(finished) / len(finished) if finished else None,
            "train_return_ewm": self.stats.smooth,
            "train_return_last": last,
            "episodes": self.stats.episodes,
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights that the rest of the run depends on."""
        return {
            "optimizer": self.learner.optimizer.state_dict(),
            "grad_steps": self.learner.grad_steps,
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
        """
        self.network.load_state_dict(weights)
        self.learner.optimizer.load_state_dict(state["optimizer"])
        self.learner.grad_steps = state["grad_steps"]
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
        return entry[:, entry.shape[1] - self.config.pqn.num_steps :]
