"""Training: collect, update, then log, evaluate, save; the same for every algorithm and memory, and for none."""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import CudaGraphModule
from torch import Tensor
from torchrl.modules import EGreedyModule

import arcade_torch
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.dqn import DQN
from arcade_torch.agents.evaluation import EvalResult, evaluate, make_eval_env, twins
from arcade_torch.agents.learner import Learner, NonFiniteError, Training, epsilon_at
from arcade_torch.agents.metrics import EpisodeStats, paper_score
from arcade_torch.agents.policy import Agent, build_network, compile_network, make_policy
from arcade_torch.agents.ppo import PPO
from arcade_torch.agents.pqn import PQN
from arcade_torch.agents.runs.checkpoint import Checkpoint, list_checkpoints, load_latest, save_checkpoint
from arcade_torch.agents.runs.files import CheckpointError, CsvLog, read_csv, write_json
from arcade_torch.agents.runs.folder import METRIC_COLUMNS, RunFolder
from arcade_torch.agents.runs.loggers import RunLogger, check_logger, open_logger
from arcade_torch.agents.runs.process import own_settings, stop_signals
from arcade_torch.envs_jax import resolve_id

Progress = Callable[[Mapping[str, Any]], None]
LEARNERS: dict[str, Callable[..., Learner]] = {"pqn": PQN, "ppo": PPO, "dqn": DQN}
COMPILE_BACKEND = "inductor"
"""Of ``torch.compile``; tests take one that needs no C++ compiler."""
_CALIBRATION_FRAMES = 3200


@dataclass(frozen=True)
class TrainResult:
    """How a run ended.

    Attributes:
        run_dir: its folder.
        status: ``"finished"`` or ``"interrupted"``.
        frames: training frames.
        seconds: time spent collecting and learning.
        evaluation: greedy evaluation at the end; None if interrupted.
        train_max_ewm: the paper's score of the training curve; None if interrupted.
    """

    run_dir: Path
    status: str
    frames: int
    seconds: float
    evaluation: EvalResult | None = None
    train_max_ewm: float | None = None


class Trainer:
    """One run in memory: environments, policy, learner, and what makes it resumable.

    Random actions are drawn from torch's global generator, as TorchRL's modules do: seed it, or use :func:`train`.

    Args:
        config: of the run.
        replay_folder: where a replay writes, made when first needed; None for a temporary folder.
    """

    def __init__(self, config: TrainConfig, replay_folder: Path | None = None) -> None:
        self.config, numbers = config, config.learner
        self.network = build_network(config)
        if config.compile:
            compile_network(self.network, COMPILE_BACKEND)
        self.total_frames = config.num_updates * numbers.frames_per_update
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        device = torch.device(config.device)
        self._random: Any = torch.cuda if device.type == "cuda" else torch  # whose generator draws the actions
        training = Training(self.total_frames, self.shuffle, device, replay_folder, config.cuda_graphs)
        self.learner = LEARNERS[config.algorithm](self.network, numbers, training)
        self.policy = make_policy(self.network)
        self.explorers = [module for module in self.policy.modules() if isinstance(module, EGreedyModule)]
        self.policy.to(device)
        self.collector = make_collector(config, self.policy, self.network)
        self.env = self.collector.env
        self.stats = EpisodeStats(np.zeros(numbers.num_envs))
        self.frames = self.updates = 0
        self.seconds = 0.0

    @property
    def done(self) -> bool:
        """Whether all updates were made."""
        return self.updates >= self.config.num_updates

    def warm_up(self) -> None:
        """Random play before training: fills the overlap and calibrates the input scaling; not counted as frames."""
        numbers = self.config.learner
        steps = max(0, numbers.warmup_steps - numbers.steps_before)  # the first window fills the overlap too
        windows = -(-steps // numbers.num_steps)
        stride = max(1, numbers.frames_per_update * windows // _CALIBRATION_FRAMES)
        seen = []
        for _ in range(windows):
            pixels = self.collector.collect(random=True).get("pixels")[:, numbers.steps_before :]
            seen.append(pixels.flatten(0, 1)[::stride].clone())
        if seen:
            self.network.calibrate(torch.cat(seen))

    def update(self) -> dict[str, Any]:
        """Collect one window and learn from it; returns a row of ``metrics.csv``.

        Raises:
            NonFiniteError: a quantity is NaN or infinite; names the update and the quantity.
        """
        began, numbers = time.perf_counter(), self.config.learner
        epsilon = epsilon_at(numbers, self.frames, self.total_frames)
        for explorer in self.explorers:
            explorer.eps.fill_(epsilon)
        batch = self.collector.collect()
        new = slice(numbers.steps_before, None)
        last = self.stats.update(*(batch["next", key][:, new].squeeze(-1) for key in ("episode_reward", "done")))
        try:
            metrics = self.learner.update(batch, self.frames)
        except NonFiniteError as error:
            raise NonFiniteError(f"update {self.updates + 1} (after {self.frames} frames): {error}") from error
        self.frames += numbers.frames_per_update
        self.updates += 1
        took = time.perf_counter() - began
        self.seconds += took
        finished = self.stats.finished
        row = {
            "frames": self.frames,
            "updates": self.updates,
            "grad_steps": self.learner.grad_steps,
            "seconds": self.seconds,
            "fps": numbers.frames_per_update / took,
            **metrics,
            "epsilon": epsilon,
            "train_return": float(finished.mean()) if len(finished) else None,
            "train_return_ewm": self.stats.smooth,
            "train_return_last": last,
            "episodes": self.stats.episodes,
        }
        return {name: value for name, value in row.items() if name in METRIC_COLUMNS}

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights that the rest of the run depends on."""
        collector = self.collector.state_dict()
        collector.pop("policy_state_dict", None)
        return {
            **self.learner.state_dict(),
            "explore": self._random.get_rng_state(),
            "shuffle": self.shuffle.get_state(),
            "collector": collector,
            "stats": self.stats.state_dict(),
            "frames": self.frames,
            "updates": self.updates,
            "seconds": self.seconds,
        }

    def load(self, checkpoint: Checkpoint) -> None:
        """Go back to where a checkpoint was made.

        Raises:
            CheckpointError: its state is not one of this trainer.
        """
        try:
            self._load(checkpoint.weights, checkpoint.trainer or {})
        except CheckpointError:
            raise
        except Exception as error:  # whatever a damaged state leads to, it is not to be used
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            raise CheckpointError(f"the state in {checkpoint.path} does not fit this run: {reason}") from error
        if self.frames != checkpoint.frames:
            raise CheckpointError(f"the state in {checkpoint.path} is not of frame {checkpoint.frames}")

    def _load(self, weights: dict[str, Tensor], state: dict[str, Any]) -> None:
        self.learner.load_state_dict(state)
        self.network.load_state_dict(weights)
        self._random.set_rng_state(state["explore"].cpu())
        self.shuffle.set_state(state["shuffle"])
        self.collector.load_state_dict(state["collector"], strict=False)
        self.stats.load_state_dict(state["stats"])
        self.frames, self.updates, self.seconds = state["frames"], state["updates"], state["seconds"]

    def close(self) -> None:
        """Let go of the environments."""
        self.collector.shutdown()


def make_collector(config: TrainConfig, policy: Any, network: Any) -> arcade_torch.ArcadeCollector:
    """The collector of a run: ``policy`` plays all environments, ``network`` says what of a frame is stored."""
    numbers = config.learner
    env = arcade_torch.make(
        config.env,
        num_envs=numbers.num_envs,
        observability=twins(config.observability, numbers.num_envs),
        obs_size=config.obs_size,
        seed=config.seed,
        device=config.device,
        rules=config.rules,
        **dict(config.env_options),
    )
    return arcade_torch.ArcadeCollector(
        env,
        CudaGraphModule(policy) if config.cuda_graphs else policy,
        frames_per_batch=numbers.frames_per_update,
        total_frames=-1,
        overlap=numbers.steps_before,
        compress=network.compress,
        final_frames="truncated" if numbers.time_limit == "bootstrap" else "none",
        store=("action_log_prob",) if config.algorithm == "ppo" else (),
        return_same_td=True,
        store_states=False,
    )


def train(
    config: TrainConfig,
    run_dir: str | os.PathLike[str],
    resume: bool = False,
    progress: Progress | None = None,
    on_evaluation: Callable[[Agent], None] | None = None,
) -> TrainResult:
    """Train an agent in a run folder.

    SIGINT and SIGTERM end the run at the next update with a checkpoint and status ``"interrupted"``; a second SIGINT
    ends it at once. A killed run goes on from its last checkpoint, to the bit on one machine. Torch's global generator
    is seeded for the run and put back afterwards.

    Args:
        config: what to train.
        run_dir: folder of the run; must be empty or absent unless ``resume``.
        resume: go on with the run in the folder (from the start if it has no checkpoint yet); a finished run returns
            its result at once, an absent one is started.
        progress: called after every update with the row of ``metrics.csv``, ``total_frames``, and ``eval_return``, the
            mean of the last greedy evaluation (None before the first).
        on_evaluation: called with the agent after every greedy evaluation; it may play, and must change nothing.

    Returns:
        How it ended.

    Raises:
        RunFolderError: the folder is taken, holds another run, or cannot be written. Nothing was changed.
        CheckpointError: ``resume`` found only damaged checkpoints.
        NonFiniteError: a quantity became NaN or infinite; names update and quantity. The last checkpoint is good.
        LoggerError: the package of ``config.logger`` is missing. Nothing was changed.
        ValueError: the game, the memory model or the network does not exist.
    """
    config = dataclasses.replace(config, env=resolve_id(config.env))
    folder = RunFolder(Path(run_dir))
    folder.check(config, resume)
    check_logger(config.logger)
    if (result := folder.finished()) is not None:
        return result_from(folder.path, result)
    with own_settings(config):
        trainer = Trainer(config, folder.replay)
        try:
            with folder.claim(config):
                if (result := folder.finished()) is not None:  # by another process, a moment ago
                    return result_from(folder.path, result)
                return _Run(config, folder, trainer, progress, on_evaluation).go()
        finally:
            trainer.close()


class _Run:
    """The loop of one run, and what it writes into its folder; arguments as in :func:`train`."""

    def __init__(
        self,
        config: TrainConfig,
        folder: RunFolder,
        trainer: Trainer,
        progress: Progress | None,
        on_evaluation: Callable[[Agent], None] | None,
    ) -> None:
        self.config, self.folder, self.trainer = config, folder, trainer
        self.progress, self.on_evaluation = progress, on_evaluation
        self.eval_env: Any = None
        self.metrics: CsvLog
        self.evals: CsvLog
        self.logger = RunLogger()
        self.last_eval: float | None = None
        self.saved_at = -1

    def go(self) -> TrainResult:
        """Run to the end, or to the first signal."""
        self._start()
        trainer, config = self.trainer, self.config
        with self._logs():
            try:
                with stop_signals() as stopped:
                    while not trainer.done and not stopped():
                        row = trainer.update()
                        self.metrics.append(row)
                        self.logger.log("train", row)
                        if self._crossed(config.eval_every) and not trainer.done:
                            self._evaluate()
                        if self._crossed(config.checkpoint_every):
                            self._save()
                        self._report("running", fps=row["fps"], train_return=row["train_return_ewm"])
                        if self.progress is not None:
                            more = {"total_frames": trainer.total_frames, "eval_return": self.last_eval}
                            self.progress(row | more)
                self._save()
                if trainer.done:
                    return self._finish()
                self._report("interrupted")
                return TrainResult(self.folder.path, "interrupted", trainer.frames, trainer.seconds)
            except NonFiniteError as error:
                self._report("failed", error=str(error))
                newest = list_checkpoints(self.folder.checkpoints)[:1]
                left = f"the last good checkpoint is {newest[0]}" if newest else "there was no checkpoint yet"
                raise NonFiniteError(f"{error}; {left}") from error
            except BaseException as error:
                status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
                self._report(status, error=f"{type(error).__name__}: {error}")
                raise

    def _start(self) -> None:
        """From the newest whole checkpoint, or from the beginning."""
        if list_checkpoints(self.folder.checkpoints):
            self.saved_at = load_latest(self.folder.checkpoints, self.config, use=self.trainer.load).frames
        else:
            self.trainer.warm_up()

    @contextlib.contextmanager
    def _logs(self) -> Iterator[None]:
        """Hold the logs open, cut back to where the trainer is."""
        frames = self.trainer.frames
        self.metrics, self.evals = self.folder.open_logs(frames)
        try:
            self.logger = open_logger(self.config, self.folder.path, frames)
            self._report("running")
            yield
        finally:
            self.metrics.close()
            self.evals.close()
            self.logger.close()

    def _crossed(self, every: int) -> bool:
        """Whether the last update passed a multiple of ``every`` frames."""
        before = self.trainer.frames - self.config.learner.frames_per_update
        return every > 0 and self.trainer.frames // every > before // every

    def _evaluate(self) -> EvalResult:
        if self.eval_env is None:
            self.eval_env = make_eval_env(self.config, self.config.eval_episodes)
        agent = Agent(self.config, self.trainer.network, self.trainer.frames)
        result = evaluate(agent, env=self.eval_env)
        row = {"frames": agent.frames, "mean": result.mean, "std": result.std, "n": len(result.returns)}
        self.evals.append(row)
        self.logger.log("eval", row)
        self.last_eval = result.mean
        if self.on_evaluation is not None:
            self.on_evaluation(agent)
        return result

    def _save(self) -> None:
        """Write a checkpoint, unless there is one of this moment."""
        trainer = self.trainer
        if self.saved_at != trainer.frames:
            weights = trainer.network.state_dict()
            save_checkpoint(self.folder.checkpoints, self.config, trainer.frames, weights, trainer.state_dict())
            self.saved_at = trainer.frames

    def _finish(self) -> TrainResult:
        began = time.perf_counter()
        result = self._evaluate()
        history = read_csv(self.folder.path / "metrics.csv")
        score = paper_score([int(r["frames"]) for r in history], [float(r["train_return_last"]) for r in history])
        final = {
            "status": "finished",
            "frames": self.trainer.frames,
            "seconds": self.trainer.seconds,
            "eval_seconds": time.perf_counter() - began,
            "mean": result.mean,
            "std": result.std,
            "ci": result.ci,
            "train_max_ewm": score,
            "returns": result.returns.tolist(),
            "lengths": result.lengths.tolist(),
        }
        write_json(self.folder.path / "eval.json", final)
        self._report("finished", mean=result.mean)
        return result_from(self.folder.path, final)

    def _report(self, status: str, **more: Any) -> None:
        self.folder.report(self.trainer.frames, self.trainer.total_frames, status, **more)


def result_from(path: Path, final: Mapping[str, Any]) -> TrainResult:
    """How a finished run ended, from its ``eval.json``."""
    evaluation = EvalResult(np.array(final["returns"], np.float32), np.array(final["lengths"], np.int64))
    return TrainResult(path, "finished", final["frames"], final["seconds"], evaluation, final["train_max_ewm"])
