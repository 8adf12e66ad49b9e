"""Where the runs of a study are carried out.

An engine takes jobs and yields one result for each as they end. A job is a JSON file, the config of a run. Progress
needs no channel of its own: every run writes ``progress.json`` into its folder.
"""

import contextlib
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from arcade_torch.tools.errors import reason

GRACE_S = 60.0
"""How long an interrupted run may take to write its checkpoint before it is killed."""

PARENT_VARIABLE = "ARCADE_TORCH_PARENT"
"""Process id that a worker watches: when that process is gone the worker stops with a checkpoint."""


@dataclass(frozen=True)
class Job:
    """One run to do.

    Attributes:
        name: of the run.
        config: JSON file with its config.
        folder: of the run; one that was begun goes on.
        log: file that takes what the run prints, or why it failed.
    """

    name: str
    config: Path
    folder: Path
    log: Path

    @property
    def argv(self) -> list[str]:
        """What follows ``arcade-torch`` on the command line."""
        files = ["--config", str(self.config), "--out", str(self.folder)]
        return ["train", *files, "--resume", "--wait", f"{GRACE_S:g}"]

    def train(self) -> None:
        """Carry it out in this process.

        Raises:
            KeyboardInterrupt: it was interrupted, and has saved.
        """
        from arcade_torch.agents import TrainConfig, train
        from arcade_torch.agents.runs.files import read_json
        from arcade_torch.agents.runs.folder import wait_until_free
        from arcade_torch.tools.keep_memory import keep_freed_memory

        keep_freed_memory()
        wait_until_free(self.folder, GRACE_S)
        if train(TrainConfig.from_dict(read_json(self.config)), self.folder, resume=True).status == "interrupted":
            raise KeyboardInterrupt


@dataclass(frozen=True)
class JobResult:
    """How a job ended; ``error`` is one line, empty for success."""

    name: str
    error: str = ""


class Engine(Protocol):
    """Carries out jobs; closing the iterator stops what still runs, in an orderly way."""

    def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
        """Yield the result of each job when it ends, in any order."""
        ...


class Inline:
    """One job after the other in this process."""

    def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
        """Run the jobs in order; an exception of one becomes its result, and its traceback goes into the log."""
        for job in jobs:
            try:
                job.train()
            except Exception as error:
                append(job.log, traceback.format_exc())
                yield JobResult(job.name, reason(error))
            else:
                yield JobResult(job.name)


def append(log: Path, text: str) -> None:
    """Add text to a log; its folder is made."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as stream:
        stream.write(text)


@dataclass
class _Worker:
    job: Job
    process: "subprocess.Popen[bytes]"
    core: int


@dataclass
class Processes:
    """Local worker processes, one a job, each on a core of its own.

    Attributes:
        workers: how many at once; one a core by default.
        program: start of the command line that takes a job's words.
        poll_s: seconds between two looks at the workers.
        grace_s: seconds an interrupted worker has for its checkpoint.
    """

    workers: int = 0
    program: Sequence[str] = (sys.executable, "-m", "arcade_torch.tools")
    poll_s: float = 0.1
    grace_s: float = GRACE_S

    def __post_init__(self) -> None:
        """Check the number of workers.

        Raises:
            ValueError: it is negative.
        """
        if self.workers < 0:
            raise ValueError(f"workers must be at least 1 (or 0 for one a core), got {self.workers}")

    def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
        """Run the jobs, `workers` at a time; on Ctrl-C or close each worker gets SIGTERM and time to save."""
        cores = available_cores()
        count = self.workers or len(cores)
        free = [cores[index % len(cores)] for index in range(count)]
        waiting, active = list(jobs), list[_Worker]()
        try:
            while waiting or active:
                while waiting and free:
                    active.append(self._start(waiting.pop(0), free.pop(0), pin=count <= len(cores)))
                for worker in [item for item in active if item.process.poll() is not None]:
                    active.remove(worker)
                    free.append(worker.core)
                    yield JobResult(worker.job.name, _error(worker))
                time.sleep(self.poll_s)
        finally:
            _stop([worker.process for worker in active], self.grace_s)

    def _start(self, job: Job, core: int, pin: bool) -> _Worker:
        append(job.log, "")
        threads = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")} if pin else {}
        with job.log.open("ab") as log:
            process = subprocess.Popen(
                [*self.program, *job.argv],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **threads, PARENT_VARIABLE: str(os.getpid())},
                start_new_session=True,  # the terminal's Ctrl-C goes to the study alone, which then stops its workers
            )
        if pin and hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(ProcessLookupError, PermissionError):  # slower without it, not wrong
                os.sched_setaffinity(process.pid, {core})
        return _Worker(job, process, core)


def available_cores() -> list[int]:
    """Numbers of the processor cores this process may use, at least one."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def watch_parent(every_s: float = 2.0) -> None:
    """In a worker: stop with a checkpoint when the study that started it is gone; elsewhere nothing happens.

    Args:
        every_s: seconds between two looks.
    """
    import signal
    import threading

    parent = os.environ.get(PARENT_VARIABLE, "")
    if not parent.isdigit() or int(parent) == os.getpid():
        return

    def look() -> None:
        while os.getppid() == int(parent):
            time.sleep(every_s)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=look, daemon=True, name="watch-parent").start()


def _stop(processes: Sequence["subprocess.Popen[bytes]"], grace_s: float) -> None:
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + grace_s
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _error(worker: _Worker) -> str:
    """Why a worker failed: its last words, and the signal that ended it; empty for success."""
    code = worker.process.returncode
    if code == 0:
        return ""
    lines = worker.job.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = lines[-1].strip().removeprefix("arcade-torch: ") if lines else ""
    if code < 0:
        return f"ended by signal {-code}" + (f"; last words: {last}" if last else "")
    return last or f"exit code {code}"
