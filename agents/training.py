"""Training in a run folder: go on from its last checkpoint, then update, log, evaluate and save to
the end, or to the first signal.
"""

import dataclasses
import errno
import math
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arcade_torch.agents.config import TrainConfig, check_config
from arcade_torch.agents.evaluation import EvalResult, evaluate, make_eval_env
from arcade_torch.agents.learner import NonFiniteError
from arcade_torch.agents.metrics import paper_score
from arcade_torch.agents.policy import Agent
from arcade_torch.agents.runs.checkpoint import load_latest, save_checkpoint
from arcade_torch.agents.runs.files import CsvLog, list_checkpoints, read_log, write_json
from arcade_torch.agents.runs.folder import EVAL_COLUMNS, METRIC_COLUMNS, RunFolder, RunFolderError
from arcade_torch.agents.runs.loggers import RunLogger, check_logger
from arcade_torch.agents.torch_settings import Settings, given_back, plain_torch
from arcade_torch.agents.trainer import Trainer
from arcade_torch.envs_jax.registry import games_of, is_mixture, resolve_id
from arcade_torch.models.generators import ONE_AT_A_TIME

Progress = Callable[[Mapping[str, Any]], None]


@dataclass(frozen=True)
class TrainResult:
    """How a run ended."""

    run_dir: Path  # its folder
    status: str  # "finished" or "interrupted"
    frames: int  # of training
    seconds: float  # spent collecting and learning
    evaluation: EvalResult | None = None  # greedy, at the end; None if interrupted
    # the paper's score of the training curve; None where an env ended no episode, or one with a
    # return that is not finite
    train_max_ewm: float | None = None


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
    run and put back afterwards: runs in threads of one process update by turns, since they share
    it, and save no time. Take processes, as a study does.

    A memory model of yours is trained as it is: `arcade_torch.models.check_memory`, which the
    command line runs first, says whether it keeps its laws.

    Args:
        config: what to train.
        run_dir: folder of the run; must be empty or absent unless ``resume``.
        resume: go on with the run in the folder (from the start if it has no checkpoint yet); a
            finished run returns its result at once, an absent one is started.
        progress: called after every update with the row of ``metrics.csv``, ``total_frames``, and
            ``eval_return``, the mean of the last greedy evaluation (None before the first). Random
            numbers that it draws change nothing.
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
        TypeError: ``config`` is none.
    """
    check_config(config)
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
        # a run that lacks nothing but its last evaluation is evaluated again
        evaluated = frames - 1 if self.trainer.done else frames
        with (
            closing(
                CsvLog(path / "metrics.csv", METRIC_COLUMNS, keep_frames=frames)
            ) as self.metrics,
            closing(CsvLog(path / "eval.csv", self._eval_columns(), evaluated)) as self.evals,
            closing(RunLogger(self.config, path, frames)) as self.logger,
        ):
            try:
                self._report("running")
                return self._loop()
            except NonFiniteError as error:
                self._report("failed", error=str(error))
                checkpoints = list_checkpoints(self.folder.checkpoints)
                left = "there was no checkpoint yet"
                if checkpoints:
                    left = f"the last good checkpoint is {checkpoints[0]}"
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

    def _eval_columns(self) -> list[str]:
        """Columns of ``eval.csv``; of a mixture with the mean of each game, named by its id."""
        if not is_mixture(self.config.env):
            return list(EVAL_COLUMNS)
        return [*EVAL_COLUMNS, *dict.fromkeys(games_of(self.config.env))]

    def _not_written(self, error: OSError) -> str:
        """What could not be written, what is safe, and how to go on."""
        where = error.filename or self.folder.path
        checkpoints = list_checkpoints(self.folder.checkpoints)
        safe = f"{checkpoints[0].name} is whole" if checkpoints else "there is no checkpoint yet"
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        too_large = error.errno == errno.EFBIG
        cure = "make room" if full else "raise ulimit -f" if too_large else "put that right"
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
                    more = {"total_frames": trainer.total_frames, "eval_return": self.last_eval}
                    self.progress(row | more)
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
        row |= {game: episodes.mean for game, episodes in result.by_game.items()}
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
        frames = []
        returns = []
        for row in read_log(self.folder.path / "metrics.csv"):
            if row["train_return_last"]:
                frames.append(float(row["frames"]))
                returns.append(float(row["train_return_last"]))
        is_finite = all(map(math.isfinite, returns))
        if not is_finite:
            warnings.warn(
                "train_max_ewm is missing: a return of the training is not finite", stacklevel=3
            )
        score = paper_score(frames, returns) if returns and is_finite else None
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
        if result.games:
            final["games"] = list(result.games)
        write_json(self.folder.path / "eval.json", final)
        self._report("finished", mean=result.mean)
        return result_from(self.folder.path, final)

    def _report(self, status: str, **more: Any) -> None:
        self.folder.report(self.trainer.frames, self.trainer.total_frames, status, **more)


def result_from(path: Path, final: Mapping[str, Any]) -> TrainResult:
    """How a finished run ended, from its ``eval.json``."""
    evaluation = EvalResult(
        np.array(final["returns"], np.float32),
        np.array(final["lengths"], np.int64),
        tuple(final.get("games", ())),
    )
    return TrainResult(
        path, "finished", final["frames"], final["seconds"], evaluation, final["train_max_ewm"]
    )


@contextmanager
def own_settings(config: TrainConfig) -> Iterator[None]:
    """Seed torch's global generators and set its threads and settings for the duration of a run."""
    with ExitStack() as stack:
        with ONE_AT_A_TIME:
            threads = torch.get_num_threads()
            stack.enter_context(given_back({torch.set_num_threads: threads}))
            torch.set_num_threads(config.threads or threads)
        stack.enter_context(plain_torch())
        stack.enter_context(own_random_numbers(torch.device(config.device), config.seed))
        yield


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
    with ExitStack() as stack:
        with ONE_AT_A_TIME:
            states: Settings = {
                generator.set_state: generator.get_state() for generator in generators
            }
            stack.enter_context(given_back(states))
            for generator in generators:
                generator.manual_seed(seed)
        yield


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
