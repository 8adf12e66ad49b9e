"""Where the runs of a study are carried out.

An engine takes jobs and yields one result for each as they end. Progress needs no channel of its own: every run writes
``progress.json`` into its folder, which any engine on a shared file system gets for free.
"""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

GRACE_S = 60.0
"""How long an interrupted run may take to write its checkpoint before it is killed."""

PARENT_VARIABLE = "ARCADE_TORCH_PARENT"
"""Process id that a worker watches: when that process is gone the worker stops with a checkpoint."""


@dataclass(frozen=True)
class Job:
    """One run to do.

    Attributes:
        name: of the run.
        words: what follows ``arcade-torch`` on the command line.
        log: file that takes what the run prints.
        folder: of the run, as it stands among the words.
    """

    name: str
    words: tuple[str, ...]
    log: Path
    folder: Path | None = None


Jobs = Iterable[Job | None]
"""Jobs to start, taken one by one as there is room; None: nothing at the moment, ask again later."""


@dataclass(frozen=True)
class JobResult:
    """How a job ended: exit code 0 is success; ``error`` is one line otherwise."""

    name: str
    exit_code: int
    error: str = ""


class Engine(Protocol):
    """Carries out jobs; closing the iterator stops what still runs, in an orderly way."""

    def run(self, jobs: Jobs) -> Iterator[JobResult]:
        """Yield the result of each job when it ends, in any order."""
        ...


class Inline:
    """One job after the other in this process."""

    def __init__(self, run_words: Callable[[Sequence[str]], int] | None = None, poll_s: float = 0.5) -> None:
        """Make the engine.

        Args:
            run_words: called with a job's words, returns an exit code; the command line by default.
            poll_s: seconds to wait where there is nothing to do at the moment.
        """
        self._run_words, self._poll_s = run_words, poll_s

    def run(self, jobs: Jobs) -> Iterator[JobResult]:
        """Run the jobs in order; an exception of one becomes its result."""
        run_words = self._run_words or _command_line
        for job in jobs:
            if job is None:
                time.sleep(self._poll_s)
                continue
            try:
                code, error = run_words(job.words), ""
            except Exception as caught:
                code, error = 1, f"{type(caught).__name__}: {' '.join(str(caught).split())}"
            yield JobResult(job.name, code, error if code else "")


def _command_line(words: Sequence[str]) -> int:
    from arcade_torch.tools.cli import EXIT_INTERRUPTED, main

    code = main(words)
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    return code


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
        environment: variables set for the workers.
        poll_s: seconds between two looks at the workers.
        grace_s: seconds an interrupted worker has for its checkpoint.
        pin: whether a worker gets a core of its own and one thread; where there are enough cores by default.
    """

    workers: int = 0
    program: Sequence[str] = (sys.executable, "-m", "arcade_torch.tools")
    environment: Mapping[str, str] = field(default_factory=dict)
    poll_s: float = 0.1
    grace_s: float = GRACE_S
    pin: bool | None = None

    def __post_init__(self) -> None:
        """Check the number of workers.

        Raises:
            ValueError: it is negative.
        """
        if self.workers < 0:
            raise ValueError(f"workers must be at least 1 (or 0 for one a core), got {self.workers}")

    def run(self, jobs: Jobs) -> Iterator[JobResult]:
        """Run the jobs, `workers` at a time; on Ctrl-C or close each worker gets SIGTERM and time to save."""
        cores = available_cores()
        count = self.workers or len(cores)
        free = [cores[index % len(cores)] for index in range(count)]
        pin = count <= len(cores) if self.pin is None else self.pin
        waiting, more, active = iter(jobs), True, list[_Worker]()
        try:
            while more or active:
                while more and free:
                    try:
                        job = next(waiting)
                    except StopIteration:
                        more = False
                        break
                    if job is None:
                        break
                    active.append(self._start(job, free.pop(0), pin))
                for worker in [item for item in active if item.process.poll() is not None]:
                    active.remove(worker)
                    free.append(worker.core)
                    yield _result(worker)
                time.sleep(self.poll_s)
        finally:
            _stop([worker.process for worker in active], self.grace_s)

    def _start(self, job: Job, core: int, pin: bool) -> _Worker:
        job.log.parent.mkdir(parents=True, exist_ok=True)
        threads = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")} if pin else {}
        environment = {**os.environ, **threads, PARENT_VARIABLE: str(os.getpid()), **self.environment}
        with job.log.open("ab") as log:
            process = subprocess.Popen(
                [*self.program, *job.words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,  # the terminal's Ctrl-C goes to the study alone, which then stops its workers
            )
        if pin and hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(ProcessLookupError, PermissionError):  # slower without it, not wrong
                os.sched_setaffinity(process.pid, {core})
        return _Worker(job, process, core)


def available_cores() -> list[int]:
    """The processor cores this process may use.

    Returns:
        Their numbers, at least one.
    """
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def watch_parent(variable: str = PARENT_VARIABLE, every_s: float = 2.0) -> None:
    """In a worker: stop with a checkpoint when the study that started it has gone, however it went.

    Args:
        variable: environment variable with the parent's process id; nothing happens where it is not set.
        every_s: seconds between two looks.
    """
    import signal
    import threading

    parent = os.environ.get(variable, "")
    if not parent.isdigit() or int(parent) == os.getpid():
        return

    def look() -> None:
        while os.getppid() == int(parent):
            time.sleep(every_s)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=look, daemon=True, name="watch-parent").start()


def _stop(processes: Sequence["subprocess.Popen[bytes]"], grace_s: float) -> None:
    for process in processes:
        if process.poll() is None:
            process.terminate()
    deadline = time.monotonic() + grace_s
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _result(worker: _Worker) -> JobResult:
    code = worker.process.returncode
    if code == 0:
        return JobResult(worker.job.name, 0)
    text = worker.job.log.read_text(encoding="utf-8", errors="replace") if worker.job.log.exists() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    reason = lines[-1] if lines else f"ended by signal {-code}" if code < 0 else f"exit code {code}"
    if code < 0:
        reason = f"ended by signal {-code}; last words: {reason}" if lines else reason
    return JobResult(worker.job.name, code, reason.removeprefix("arcade-torch: "))
