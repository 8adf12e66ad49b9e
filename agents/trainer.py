"""One run in memory: collect, learn, and what makes it resumable; the same for every algorithm and
memory, and for none.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.modules import EGreedyModule

import arcade_torch
from arcade_torch.agents.checked import require
from arcade_torch.agents.config import TrainConfig, check_config
from arcade_torch.agents.cuda_graph import GraphedPolicy
from arcade_torch.agents.dqn import DQN
from arcade_torch.agents.evaluation import make_env
from arcade_torch.agents.learner import (
    Learner,
    NonFiniteError,
    Training,
    check_return_range,
    epsilon_at,
    move_mean,
    window_share,
)
from arcade_torch.agents.metrics import EpisodeStats
from arcade_torch.agents.policy import build_network, compile_network, make_policy
from arcade_torch.agents.ppo import PPO
from arcade_torch.agents.pqn import PQN
from arcade_torch.agents.runs.checkpoint import Checkpoint
from arcade_torch.agents.runs.files import CheckpointError
from arcade_torch.agents.runs.folder import METRIC_COLUMNS
from arcade_torch.agents.runs.states import check_state
from arcade_torch.agents.torch_settings import plain_torch
from arcade_torch.devices import pick_devices
from arcade_torch.envs_jax.game import check_ends
from arcade_torch.envs_jax.registry import is_built_in
from arcade_torch.models.generators import ONE_AT_A_TIME

LEARNERS: dict[str, Callable[..., PQN | PPO | DQN]] = {"pqn": PQN, "ppo": PPO, "dqn": DQN}
COMPILE_BACKEND = "inductor"
"""Of ``torch.compile``; tests take one that needs no C++ compiler."""


class Trainer:
    """One run in memory: environments, policy, learner, and what makes it resumable.

    The seed of the config decides what is drawn, whoever else seeds torch or draws from it between
    two updates; TorchRL's modules draw from torch's global generator, which gets the numbers of the
    run for the length of an update. Other settings of torch are those of a fresh process
    (:func:`plain_torch`).

    Args:
        config: of the run.
        replay_folder: where a replay writes, made when first needed; None for a temporary folder.

    Raises:
        ValueError: the device is not there; the game, the memory model, the network or one of their
            options is unknown.
        TypeError: ``config`` is none.
    """

    def __init__(self, config: TrainConfig, replay_folder: Path | None = None) -> None:
        check_config(config)
        self.config = config
        device, _ = pick_devices(config.device)  # refused here if it is not there
        self.random = torch.default_generator
        if device.type == "cuda":
            self.random = torch.cuda.default_generators[device.index]
        generator = torch.Generator(self.random.device).manual_seed(config.seed)
        self.random_state = generator.get_state()
        with self._own_settings():
            self._make(device, replay_folder)

    def _make(self, device: torch.device, replay_folder: Path | None) -> None:
        """Make networks, learner, environments and collector."""
        config = self.config
        numbers = config.learner
        self.network = build_network(config)  # learns
        # acts, is evaluated and saved: a mean of the weights, or the network that learns itself
        self.acting = build_network(config) if numbers.average_share else self.network
        self.networks = {self.network, self.acting}  # one, or two
        if config.compile:
            for network in self.networks:
                compile_network(network, COMPILE_BACKEND)
        self.total_frames = config.num_updates * numbers.frames_per_update
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        training = Training(
            self.total_frames, self.shuffle, device, replay_folder, config.cuda_graphs
        )
        self.learner = LEARNERS[config.algorithm](self.network, numbers, training)
        self.policy = make_policy(self.acting)
        self.explorers = [
            module for module in self.policy.modules() if isinstance(module, EGreedyModule)
        ]
        self.env = make_env(config, numbers.num_envs, config.seed)
        self.ends_in_time = is_built_in(config.env)  # others have to show it
        self.return_range = self.env.game.return_range
        if numbers.average_share:
            check_return_range(self.env.game.id, self.return_range)
        self.collector = arcade_torch.ArcadeCollector(
            self.env,
            GraphedPolicy(self.policy) if config.cuda_graphs else self.policy,
            frames_per_batch=numbers.frames_per_update,
            total_frames=-1,
            overlap=numbers.steps_before,
            compress=self.network.compress,
            final_frames="truncated" if numbers.time_limit == "bootstrap" else "none",
            store=("action_log_prob",) if config.algorithm == "ppo" else (),
            return_same_td=True,
            store_states=False,
        )
        self.stats = EpisodeStats(np.full(numbers.num_envs, np.nan))
        self.frames = 0
        self.updates = 0
        self.seconds = 0.0

    @property
    def done(self) -> bool:
        """Whether all updates were made."""
        return self.updates >= self.config.num_updates

    @contextmanager
    def _own_settings(self) -> Iterator[None]:
        """While open, torch draws and computes as this run does; others find theirs again, and runs
        in other threads wait.
        """
        with ONE_AT_A_TIME:
            before = self.random.get_state()
            self.random.set_state(self.random_state)
            try:
                with plain_torch():
                    yield
            finally:
                self.random_state = self.random.get_state()
                self.random.set_state(before)

    def warm_up(self) -> None:
        """Random play before training: fills the overlap and calibrates the input scaling; not
        counted as frames.
        """
        numbers = self.config.learner
        # the first window fills the overlap too
        steps = max(0, numbers.warmup_steps - numbers.steps_before)
        windows = -(-steps // numbers.num_steps)
        if not windows:
            return
        stride = max(1, numbers.frames_per_update * windows // 3200)  # 3,200 frames are plenty
        seen = []
        with self._own_settings():
            for _ in range(windows):
                batch = self.collector.collect(random=True)
                pixels = batch["pixels"][:, numbers.steps_before :]
                seen.append(pixels.flatten(0, 1)[::stride].clone())
            for network in self.networks:
                network.calibrate(torch.cat(seen))

    def update(self) -> dict[str, Any]:
        """Collect one window and learn from it; returns a row of ``metrics.csv``.

        Raises:
            NonFiniteError: a quantity is NaN or infinite; names the update and the quantity.
            ValueError: an episode of a game of one's own does not end in time.
        """
        with self._own_settings():
            return self._update()

    def _update(self) -> dict[str, Any]:
        began = time.perf_counter()
        numbers = self.config.learner
        epsilon = epsilon_at(numbers, self.frames, self.total_frames)
        for explorer in self.explorers:
            explorer.eps.fill_(epsilon)
        batch = self.collector.collect()
        if not self.ends_in_time:
            check_ends(self.env.game, int(batch["step_count"].max()))
        new = slice(numbers.steps_before, None)
        returns = batch["next", "episode_reward"][:, new].squeeze(-1)
        done = batch["next", "done"][:, new].squeeze(-1)
        last = self.stats.update(returns, done)
        try:
            if not bool(batch["next", "reward"].isfinite().all()):
                raise NonFiniteError("a reward is not finite")
            metrics = self.learner.update(batch, self.frames)
        except NonFiniteError as error:
            raise NonFiniteError(
                f"update {self.updates + 1} (after {self.frames} frames): {error}"
            ) from error
        self.frames += numbers.frames_per_update
        self.updates += 1
        if self.acting is not self.network:
            share = window_share(self.stats.smooth, self.return_range)
            move_mean(self.acting, self.network, share * numbers.average_share * self.updates)
        took = time.perf_counter() - began
        self.seconds += took
        row = {
            "frames": self.frames,
            "updates": self.updates,
            "grad_steps": self.learner.grad_steps,
            "seconds": self.seconds,
            "fps": numbers.frames_per_update / took,
            **metrics,
            "epsilon": epsilon,
            "train_return": float(self.stats.finished.mean()) if len(self.stats.finished) else None,
            "train_return_ewm": self.stats.smooth,
            "train_return_last": last,
            "episodes": self.stats.episodes,
        }
        return {name: value for name, value in row.items() if name in METRIC_COLUMNS}

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights that the rest of the run depends on."""
        return {
            **self.learner.state_dict(),
            "network": None if self.network is self.acting else self.network.state_dict(),
            **self._own_state(),
        }

    def _own_state(self) -> dict[str, Any]:
        """The part of the state that is neither the learner's nor weights."""
        collector = self.collector.state_dict()
        collector.pop("policy_state_dict", None)
        return {
            "explore": self.random_state,
            "shuffle": self.shuffle.get_state(),
            "collector": collector,
            "stats": self.stats.state_dict(),
            "frames": self.frames,
            "updates": self.updates,
            "seconds": self.seconds,
        }

    @plain_torch()
    def load(self, checkpoint: Checkpoint) -> None:
        """Go back to where a checkpoint was made; a ``CheckpointError`` if its state is not one of
        this trainer.
        """
        state: Any = {} if checkpoint.trainer is None else checkpoint.trainer
        try:
            check_state(state, self._expected_state())
            self.learner.load_state_dict(state)
            self.acting.load_state_dict(checkpoint.weights)
            self.network.load_state_dict(state.get("network") or checkpoint.weights)
            generator = torch.Generator(self.random.device)
            generator.set_state(state["explore"].cpu())  # refuses what is no state
            self.random_state = generator.get_state()
            self.shuffle.set_state(state["shuffle"])
            self.collector.load_state_dict(state["collector"], strict=False)
            self.stats.load_state_dict(state["stats"])
            self.frames = state["frames"]
            self.updates = state["updates"]
            self.seconds = state["seconds"]
            allowed = f"{checkpoint.frames}, as in its name"
            require(self.frames == checkpoint.frames, "frames", self.frames, allowed)
            updated_frames = self.updates * self.config.learner.frames_per_update
            allowed = f"as many as make {self.frames} frames"
            require(self.frames == updated_frames, "updates", self.updates, allowed)
        except CheckpointError:
            raise
        except Exception as error:  # whatever a damaged state leads to, it is not to be used
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            raise CheckpointError(
                f"the state in {checkpoint.path} does not fit this run: {reason}"
            ) from error

    def _expected_state(self) -> dict[str, Any]:
        """What a saved state of this trainer looks like; the replay, which looks at its files
        itself, is left out.
        """
        learner = Learner.state_dict(self.learner)
        learner.pop("optimizer")  # looks at its averages itself, and keeps its own options
        return {**learner, "learner_updates": 0, **self._own_state()}

    def close(self) -> None:
        """Let go of the environments."""
        self.collector.shutdown()
