"""Where the runs of a study are carried out.

An engine takes jobs and yields one result for each as they end. A job is a JSON file, the config of a run. Progress
needs no channel of its own: every run writes ``progress.json`` into its folder.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from arcade_torch.tools.errors import reason

GRACE_S = 60.0
"""How long an interrupted run may take to write its checkpoint before it is killed."""

PARENT_VARIABLE = "ARCADE_TORCH_PARENT"
"""Process id that a worker watches: when that process is gone the worker stops with a checkpoint."""


class Job(NamedTuple):
    """One run to do: its name, JSON file with its config, its folder, and the log for what it prints."""

    name: str
    config: Path
    folder: Path
    log: Path

    def train(self) -> None:
        """Carry it out in this process; a run that was begun goes on.

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

    def add_to_log(self, text: str) -> None:
        """Add text to the log; its folder is made."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("a", encoding="utf-8") as stream:
            stream.write(text)


class JobResult(NamedTuple):
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
                job.add_to_log(traceback.format_exc())
                yield JobResult(job.name, reason(error))
            else:
                yield JobResult(job.name)


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

    def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
        """Run the jobs, `workers` at a time; on Ctrl-C or close each worker gets SIGTERM and time to save."""
        cores = available_cores()
        count = self.workers or len(cores)
        free = [cores[index % len(cores)] for index in range(count)]
        waiting, active = list(jobs), dict[subprocess.Popen[bytes], tuple[Job, int]]()
        try:
            while waiting or active:
                while waiting and free:
                    job, core = waiting.pop(0), free.pop(0)
                    active[self._start(job, core, pin=count <= len(cores))] = job, core
                for process in [each for each in active if each.poll() is not None]:
                    job, core = active.pop(process)
                    free.append(core)
                    yield JobResult(job.name, _error(process.returncode, job.log))
                time.sleep(self.poll_s)
        finally:
            for process in active:
                process.terminate()
            deadline = time.monotonic() + self.grace_s
            for process in active:
                try:
                    process.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()

    def _start(self, job: Job, core: int, pin: bool) -> "subprocess.Popen[bytes]":
        job.add_to_log("")
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1") if pin else {}
        files = ["--config", str(job.config), "--out", str(job.folder)]
        with job.log.open("ab") as log:
            process = subprocess.Popen(
                [*self.program, "train", *files, "--resume", "--wait", f"{GRACE_S:g}"],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **threads, PARENT_VARIABLE: str(os.getpid())},
                start_new_session=True,  # the terminal's Ctrl-C goes to the study alone, which then stops its workers
            )
        if pin and hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(ProcessLookupError, PermissionError):  # slower without it, not wrong
                os.sched_setaffinity(process.pid, {core})
        return process


def available_cores() -> list[int]:
    """Numbers of the processor cores this process may use, at least one."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [*range(os.cpu_count() or 1)]


def watch_parent(every_s: float = 2.0) -> None:
    """In a worker: stop with a checkpoint when the study that started it is gone; elsewhere nothing happens."""
    parent = os.environ.get(PARENT_VARIABLE, "")
    if not parent.isdigit() or int(parent) == os.getpid():
        return

    def look() -> None:
        while os.getppid() == int(parent):
            time.sleep(every_s)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=look, daemon=True, name="watch-parent").start()


def _error(code: int, log: Path) -> str:
    """Why a worker failed: its last words, and the signal that ended it; empty for success."""
    if code == 0:
        return ""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = lines[-1].strip().removeprefix("arcade-torch: ") if lines else ""
    if code < 0:
        return f"ended by signal {-code}" + (f"; last words: {last}" if last else "")
    return last or f"exit code {code}"
