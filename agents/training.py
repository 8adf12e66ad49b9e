"""Training: collect, update, then log, evaluate, save; the same for every algorithm and memory, and
for none.
"""

import dataclasses
import errno
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.modules import EGreedyModule

import arcade_torch
from arcade_torch.agents.config import TrainConfig, require
from arcade_torch.agents.cuda_graph import GraphedPolicy
from arcade_torch.agents.dqn import DQN
from arcade_torch.agents.evaluation import EvalResult, evaluate, make_env, make_eval_env
from arcade_torch.agents.learner import (
    Learner,
    NonFiniteError,
    Training,
    check_return_range,
    epsilon_at,
    move_mean,
    window_share,
)
from arcade_torch.agents.metrics import EpisodeStats, paper_score
from arcade_torch.agents.policy import Agent, build_network, compile_network, make_policy
from arcade_torch.agents.ppo import PPO
from arcade_torch.agents.pqn import PQN
from arcade_torch.agents.runs.checkpoint import (
    Checkpoint,
    list_checkpoints,
    load_latest,
    save_checkpoint,
)
from arcade_torch.agents.runs.files import CheckpointError, CsvLog, read_csv, write_json
from arcade_torch.agents.runs.folder import EVAL_COLUMNS, METRIC_COLUMNS, RunFolder, RunFolderError
from arcade_torch.agents.runs.loggers import RunLogger, check_logger
from arcade_torch.agents.runs.states import check_state
from arcade_torch.devices import pick_devices
from arcade_torch.envs_jax import resolve_id

Progress = Callable[[Mapping[str, Any]], None]
LEARNERS: dict[str, Callable[..., PQN | PPO | DQN]] = {"pqn": PQN, "ppo": PPO, "dqn": DQN}
COMPILE_BACKEND = "inductor"
"""Of ``torch.compile``; tests take one that needs no C++ compiler."""


@dataclass(frozen=True)
class TrainResult:
    """How a run ended."""

    run_dir: Path  # its folder
    status: str  # "finished" or "interrupted"
    frames: int  # of training
    seconds: float  # spent collecting and learning
    evaluation: EvalResult | None = None  # greedy, at the end; None if interrupted
    # the paper's score of the training curve; None where an env ended no episode
    train_max_ewm: float | None = None


class Trainer:
    """One run in memory: environments, policy, learner, and what makes it resumable.

    Random actions are drawn from torch's global generator, as TorchRL's modules do: seed it, or use
    :func:`train`.

    Args:
        config: of the run.
        replay_folder: where a replay writes, made when first needed; None for a temporary folder.

    Raises:
        ValueError: the device is not there; the game, the memory model, the network or one of their
            options is unknown.
    """

    def __init__(self, config: TrainConfig, replay_folder: Path | None = None) -> None:
        self.config = config
        numbers = config.learner
        device, _ = pick_devices(config.device)  # refused here if it is not there
        self.network = build_network(config)  # learns
        # is saved, too
        self.acting = build_network(config) if numbers.average_share else self.network
        for network in {self.network, self.acting} if config.compile else ():
            compile_network(network, COMPILE_BACKEND)
        self.total_frames = config.num_updates * numbers.frames_per_update
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        self.random = (
            torch.cuda.default_generators[device.index]
            if device.type == "cuda"
            else torch.default_generator
        )
        training = Training(
            self.total_frames, self.shuffle, device, replay_folder, config.cuda_graphs
        )
        self.learner = LEARNERS[config.algorithm](self.network, numbers, training)
        self.policy = make_policy(self.acting)
        self.explorers = [
            module for module in self.policy.modules() if isinstance(module, EGreedyModule)
        ]
        self.env = make_env(config, numbers.num_envs, config.seed)
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

    def warm_up(self) -> None:
        """Random play before training: fills the overlap and calibrates the input scaling; not
        counted as frames.
        """
        numbers = self.config.learner
        # the first window fills the overlap too
        steps = max(0, numbers.warmup_steps - numbers.steps_before)
        windows = -(-steps // numbers.num_steps)
        stride = max(1, numbers.frames_per_update * windows // 3200)  # 3,200 frames are plenty
        seen = []
        for _ in range(windows):
            pixels = self.collector.collect(random=True).get("pixels")[:, numbers.steps_before :]
            seen.append(pixels.flatten(0, 1)[::stride].clone())
        for network in {self.network, self.acting} if seen else ():
            network.calibrate(torch.cat(seen))

    def update(self) -> dict[str, Any]:
        """Collect one window and learn from it; returns a row of ``metrics.csv``.

        Raises:
            NonFiniteError: a quantity is NaN or infinite; names the update and the quantity.
        """
        began = time.perf_counter()
        numbers = self.config.learner
        epsilon = epsilon_at(numbers, self.frames, self.total_frames)
        for explorer in self.explorers:
            explorer.eps.fill_(epsilon)
        batch = self.collector.collect()
        new = slice(numbers.steps_before, None)
        last = self.stats.update(
            *(batch["next", key][:, new].squeeze(-1) for key in ("episode_reward", "done"))
        )
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
        collector = self.collector.state_dict()
        collector.pop("policy_state_dict", None)
        return {
            **self.learner.state_dict(),
            "network": None if self.network is self.acting else self.network.state_dict(),
            "explore": self.random.get_state(),
            "shuffle": self.shuffle.get_state(),
            "collector": collector,
            "stats": self.stats.state_dict(),
            "frames": self.frames,
            "updates": self.updates,
            "seconds": self.seconds,
        }

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
            self.random.set_state(state["explore"].cpu())
            self.shuffle.set_state(state["shuffle"])
            self.collector.load_state_dict(state["collector"], strict=False)
            self.stats.load_state_dict(state["stats"])
            self.frames = state["frames"]
            self.updates = state["updates"]
            self.seconds = state["seconds"]
            require(
                self.frames == checkpoint.frames,
                "frames",
                self.frames,
                f"{checkpoint.frames}, as in its name",
            )
            updated_frames = self.updates * self.config.learner.frames_per_update
            require(
                self.frames == updated_frames,
                "updates",
                self.updates,
                f"as many as make {self.frames} frames",
            )
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
        collector = self.collector.state_dict()
        collector.pop("policy_state_dict", None)
        learner = Learner.state_dict(self.learner)
        learner.pop("optimizer")  # looks at its averages itself, and keeps its own options
        counters = dict.fromkeys(("learner_updates", "frames", "updates"), 0)
        return {
            **learner,
            **counters,
            "explore": self.random.get_state(),
            "shuffle": self.shuffle.get_state(),
            "collector": collector,
            "stats": self.stats.state_dict(),
            "seconds": 0.0,
        }

    def close(self) -> None:
        """Let go of the environments."""
        self.collector.shutdown()


def train(
    config: TrainConfig,
    run_dir: str | os.PathLike[str],
    resume: bool = False,
    progress: Progress | None = None,
    on_evaluation: Callable[[Agent], None] | None = None,
    imports: Sequence[Mapping[str, str]] = (),
) -> TrainResult:
    """Train an agent in a run folder.

    SIGINT, SIGTERM and SIGHUP (a dropped connection) end the run at the next update with a
    checkpoint and status ``"interrupted"``; a second SIGINT ends it at once. A killed run goes on
    from its last checkpoint, to the bit on one machine. Torch's global generator is seeded for the
    run and put back afterwards.

    Args:
        config: what to train.
        run_dir: folder of the run; must be empty or absent unless ``resume``.
        resume: go on with the run in the folder (from the start if it has no checkpoint yet); a
            finished run returns its result at once, an absent one is started.
        progress: called after every update with the row of ``metrics.csv``, ``total_frames``, and
            ``eval_return``, the mean of the last greedy evaluation (None before the first).
        on_evaluation: called with the agent after every greedy evaluation; it may play, and must
            change nothing.
        imports: files and modules that game and memory came from, each with ``name`` and
            ``sha256``; only kept in ``config.json``, for whoever opens the run.

    Returns:
        How it ended.

    Raises:
        RunFolderError: the folder is taken, holds another run, or cannot be written: nothing was
            changed. Or it was removed, or its disk is full, during the training: the last
            checkpoint is whole.
        CheckpointError: ``resume`` found only damaged checkpoints.
        NonFiniteError: a quantity became NaN or infinite; names update and quantity. The last
            checkpoint is good.
        LoggerError: the package of ``config.logger`` is missing. Nothing was changed.
        ValueError: the game, the memory model, the network or the device does not exist.
    """
    config = dataclasses.replace(config, env=resolve_id(config.env))
    folder = RunFolder(Path(run_dir), imports)
    folder.check(config, resume)
    check_logger(config.logger)
    if (result := folder.finished()) is not None:
        return result_from(folder.path, result)
    with (
        own_settings(config),
        closing(Trainer(config, folder.replay)) as trainer,
        folder.claim(config),
    ):
        if (result := folder.finished()) is not None:  # by another process, a moment ago
            return result_from(folder.path, result)
        return _Run(config, folder, trainer, progress, on_evaluation).go()


@dataclass
class _Run:
    """The loop of one run, and what it writes into its folder; the first five as in
    :func:`train`.
    """

    config: TrainConfig
    folder: RunFolder
    trainer: Trainer
    progress: Progress | None
    on_evaluation: Callable[[Agent], None] | None
    eval_env: Any = None
    last_eval: float | None = None
    saved_at: int = -1

    def go(self) -> TrainResult:
        """Run from the newest whole checkpoint, or the beginning, to the end, or to the first
        signal.
        """
        if list_checkpoints(self.folder.checkpoints):
            self.saved_at = load_latest(
                self.folder.checkpoints, self.config, use=self.trainer.load
            ).frames
        else:
            self.trainer.warm_up()
        path = self.folder.path
        frames = self.trainer.frames
        with (
            closing(
                CsvLog(path / "metrics.csv", METRIC_COLUMNS, keep_frames=frames)
            ) as self.metrics,
            closing(
                CsvLog(path / "eval.csv", EVAL_COLUMNS, keep_frames=frames - self.trainer.done)
            ) as self.evals,
            closing(RunLogger(self.config, path, frames)) as self.logger,
        ):
            try:
                self._report("running")
                return self._loop()
            except NonFiniteError as error:
                self._report("failed", error=str(error))
                newest = list_checkpoints(self.folder.checkpoints)[:1]
                left = (
                    f"the last good checkpoint is {newest[0]}"
                    if newest
                    else "there was no checkpoint yet"
                )
                raise NonFiniteError(f"{error}; {left}") from error
            except OSError as error:  # a full disk, for one
                with suppress(OSError):
                    self._report("failed", error=f"{type(error).__name__}: {error}")
                raise RunFolderError(self._not_written(error)) from error
            except BaseException as error:
                status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
                with suppress(OSError):
                    self._report(status, error=f"{type(error).__name__}: {error}")
                raise

    def _not_written(self, error: OSError) -> str:
        """What could not be written, what is safe, and how to go on."""
        where = error.filename or self.folder.path
        newest = list_checkpoints(self.folder.checkpoints)[:1]
        safe = f"{newest[0].name} is whole" if newest else "there is no checkpoint yet"
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        cure = "make room" if full else "put that right"
        return (
            f"could not write {where}: {error.strerror or error}; {safe}: {cure}, then go on with "
            "--resume"
        )

    def _loop(self) -> TrainResult:
        trainer = self.trainer
        config = self.config
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
                    self.progress(
                        row | {"total_frames": trainer.total_frames, "eval_return": self.last_eval}
                    )
        self._save()
        if trainer.done:
            return self._finish()
        self._report("interrupted")
        return TrainResult(self.folder.path, "interrupted", trainer.frames, trainer.seconds)

    def _crossed(self, interval: int) -> bool:
        """Whether the last update passed a multiple of ``interval`` frames."""
        before = self.trainer.frames - self.config.learner.frames_per_update
        return interval > 0 and self.trainer.frames // interval > before // interval

    def _evaluate(self) -> EvalResult:
        if self.eval_env is None:
            self.eval_env = make_eval_env(self.config, self.config.eval_episodes)
        agent = Agent(self.config, self.trainer.acting, self.trainer.frames)
        result = evaluate(agent, env=self.eval_env)
        row = {
            "frames": agent.frames,
            "mean": result.mean,
            "std": result.std,
            "n": len(result.returns),
        }
        self.evals.append(row)
        self.logger.log("eval", row)
        self.last_eval = result.mean
        if self.on_evaluation is not None:
            self.on_evaluation(agent)
        return result

    def _save(self) -> None:
        """Write a checkpoint, unless there is one of this moment."""
        trainer = self.trainer
        self.folder.check_there()
        if self.saved_at != trainer.frames:
            weights = trainer.acting.state_dict()
            save_checkpoint(
                self.folder.checkpoints, self.config, trainer.frames, weights, trainer.state_dict()
            )
            self.saved_at = trainer.frames

    def _finish(self) -> TrainResult:
        began = time.perf_counter()
        result = self._evaluate()
        rows = [
            row
            for row in read_csv(self.folder.path / "metrics.csv", strict=False)
            if row["train_return_last"]
        ]
        points = [[float(row[name]) for row in rows] for name in ("frames", "train_return_last")]
        score = paper_score(points[0], points[1]) if rows else None
        final = {
            "status": "finished",
            "frames": self.trainer.frames,
            "seconds": self.trainer.seconds,
            "eval_seconds": time.perf_counter() - began,
            "mean": result.mean,
            "std": result.std,
            "ci": result.half_width,
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
    evaluation = EvalResult(
        np.array(final["returns"], np.float32), np.array(final["lengths"], np.int64)
    )
    return TrainResult(
        path, "finished", final["frames"], final["seconds"], evaluation, final["train_max_ewm"]
    )


@contextmanager
def own_settings(config: TrainConfig) -> Iterator[None]:
    """Seed torch's global generators and set its threads for the duration of a run."""
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(config.threads or threads)
        with own_random_numbers(torch.device(config.device), config.seed):
            yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def own_random_numbers(device: torch.device, seed: int) -> Iterator[None]:
    """Seed torch's global generators of the CPU and of one GPU, and put them back afterwards; those
    of other GPUs stay as they are.
    """
    generators = [torch.default_generator]
    if device.type == "cuda" and torch.cuda.is_available():  # else the run refuses it
        torch.cuda.init()
        index = torch.cuda.current_device() if device.index is None else device.index
        generators.append(torch.cuda.default_generators[index])
    states = [generator.get_state() for generator in generators]
    try:
        for generator in generators:
            generator.manual_seed(seed)
        yield
    finally:
        for generator, state in zip(generators, states, strict=True):
            generator.set_state(state)


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT, SIGTERM and SIGHUP into a request to stop.

    A signal that is ignored (SIGHUP under ``nohup``) stays so, and outside the main thread all stay
    as they are.
    """
    asked = threading.Event()

    def ask(number: int, frame: object) -> None:
        if asked.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.set()

    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, ask)
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
