"""The training loop: collect, learn, log, evaluate, save; the same for every algorithm, memory model, and for none."""

import contextlib
import dataclasses
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch

from arcade_torch.agents.agent import Agent
from arcade_torch.agents.checkpoint import Checkpoint, CheckpointError, list_checkpoints, load_latest, save_checkpoint
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.evaluation import EvalResult, evaluate, make_eval_env
from arcade_torch.agents.files import CsvLog, read_csv, write_json
from arcade_torch.agents.learner import NonFiniteError
from arcade_torch.agents.loggers import RunLogger, check_logger, open_logger
from arcade_torch.agents.metrics import paper_score
from arcade_torch.agents.run_folder import RunFolder
from arcade_torch.agents.trainer import Trainer
from arcade_torch.envs_jax import resolve_id

Progress = Callable[[Mapping[str, Any]], None]


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


def train(
    config: TrainConfig,
    run_dir: str | os.PathLike[str],
    resume: bool = False,
    progress: Progress | None = None,
    on_evaluation: Callable[[Agent], None] | None = None,
) -> TrainResult:
    """Train an agent in a run folder.

    SIGINT and SIGTERM end the run at the next update with a checkpoint and status ``"interrupted"``; a second SIGINT
    ends it at once. A killed run goes on from its last checkpoint, to the bit on one machine.

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
    with torch_threads(config.threads):
        trainer = Trainer(config, folder.replay)
        try:
            with folder.claim(config):
                if (result := folder.finished()) is not None:  # by another process, a moment ago
                    return result_from(folder.path, result)
                return Run(config, folder, trainer, progress, on_evaluation).go()
        finally:
            trainer.close()


class Run:
    """The loop of one run and what it writes: :meth:`go`, or its parts for runs that are moved together.

    Args:
        config: of the run.
        folder: of the run, claimed.
        trainer: a ``Trainer``, or what shows its rows, network, state and counts where :meth:`go` is not used.
        progress: see :func:`train`.
        on_evaluation: see :func:`train`.
    """

    def __init__(
        self,
        config: TrainConfig,
        folder: RunFolder,
        trainer: Any,
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
        with self.logs():
            try:
                with stop_signals() as stopped:
                    while not self.trainer.done and not stopped():
                        self.update()
                return self.end()
            except NonFiniteError as error:
                self.failed(error)
                raise NonFiniteError(f"{error}; {self.last_good()}") from error
            except BaseException as error:
                self.failed(error)
                raise

    @contextlib.contextmanager
    def logs(self) -> Iterator[None]:
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

    def end(self) -> TrainResult:
        """Save, and evaluate if all updates were made."""
        trainer = self.trainer
        self.save()
        if not trainer.done:
            self._report("interrupted")
            return TrainResult(self.folder.path, "interrupted", trainer.frames, trainer.seconds)
        return self._finish()

    def failed(self, error: BaseException) -> None:
        """Say in the folder why the run ended."""
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        kind = "" if isinstance(error, NonFiniteError) else f"{type(error).__name__}: "
        self._report(status, error=f"{kind}{error}")

    def last_good(self) -> str:
        """Words on what is left after a failure."""
        newest = list_checkpoints(self.folder.checkpoints)[:1]
        return f"the last good checkpoint is {newest[0]}" if newest else "there was no checkpoint yet"

    def _start(self) -> None:
        """From the newest whole checkpoint, or from the beginning."""
        if list_checkpoints(self.folder.checkpoints):
            found = load_latest(
                self.folder.checkpoints, expect=self.config, use=lambda found: go_on_from(self.trainer, found)
            )
            self.saved_at = found.frames
        else:
            self.trainer.warm_up()

    def update(self) -> None:
        """One update, and what is due after it."""
        trainer = self.trainer
        row = trainer.update()
        self.metrics.append(row)
        self.logger.log("train", row)
        if self._crossed(self.config.eval_every) and not trainer.done:
            self._evaluate()
        if self._crossed(self.config.checkpoint_every):
            self.save()
        self._report("running", fps=row["fps"], train_return=row["train_return_ewm"])
        if self.progress is not None:
            self.progress(row | {"total_frames": trainer.total_frames, "eval_return": self.last_eval})

    def _crossed(self, every: int) -> bool:
        """Whether the last update passed a multiple of ``every`` frames."""
        before = self.trainer.frames - self.config.learner.frames_per_update
        crossed: bool = every > 0 and self.trainer.frames // every > before // every
        return crossed

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

    def save(self) -> None:
        """Write a checkpoint, unless there is one of this moment."""
        trainer = self.trainer
        if self.saved_at == trainer.frames:
            return
        self.folder.lease.confirm()
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


def go_on_from(trainer: Trainer, checkpoint: Checkpoint) -> None:
    """Put a trainer where a checkpoint was made.

    Raises:
        CheckpointError: its state is not one of this trainer.
    """
    try:
        trainer.load(checkpoint.weights, checkpoint.trainer or {})
        whole = bool(trainer.frames == checkpoint.frames)
    except CheckpointError:
        raise
    except Exception as error:  # whatever a damaged state leads to, it is not to be used
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise CheckpointError(f"the state in {checkpoint.path} does not fit this run: {reason}") from error
    if not whole:
        raise CheckpointError(f"the state in {checkpoint.path} is not of frame {checkpoint.frames}")


def result_from(path: Path, final: Mapping[str, Any]) -> TrainResult:
    """How a finished run ended, from its ``eval.json``."""
    evaluation = EvalResult(np.array(final["returns"], np.float32), np.array(final["lengths"], np.int64))
    return TrainResult(path, "finished", final["frames"], final["seconds"], evaluation, final["train_max_ewm"])


@contextlib.contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Torch threads for the duration of a run; 0 leaves them alone."""
    before = torch.get_num_threads()
    if number:
        torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a request to stop; outside the main thread, signals stay as they are."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if asked.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
