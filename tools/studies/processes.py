"""The engine of one machine: processes that carry out the runs of a study, one run after the other.

To import torch, JAX and TorchRL and to compile a game takes ten seconds of a core, as long as a
third of a short run, so a process that has carried out a run takes another (`arcade_torch.tools.
worker`). One in which a run has failed, or which has worked for long, is replaced.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from arcade_torch.agents.runs.files import open_append, read_end
from arcade_torch.tools.machine import PARENT_VARIABLE, available_cores
from arcade_torch.tools.studies.engines import GRACE_S, Command, Job, JobResult

MOST_RUNS = 32
"""Runs that one process carries out."""
DONE = b"done\n"
"""What a process says after a run that has succeeded."""
FAILED = b"failed\n"
"""What it says after one that has failed, before it ends: why is the last line of the log."""
LONG_S = 600.0
"""A process that has worked for so many seconds takes no further run: long ones gain nothing."""

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass
class Processes:
    """Local worker processes; where they are as many as the cores, each on a core of its own."""

    workers: int = 0  # how many at once; one a core by default
    # command line of a worker
    program: Sequence[str] = (sys.executable, "-m", "arcade_torch.tools.worker")
    poll_s: float = 0.1  # between two looks at the workers
    grace_s: float = GRACE_S

    def run(self, jobs: Iterable[Job | Command]) -> Iterator[JobResult]:
        """Run the jobs, `workers` at a time; on Ctrl-C or close each worker gets SIGTERM and time
        to save.
        """
        waiting = list(jobs)
        environment = os.environ | _ONE_THREAD | {PARENT_VARIABLE: str(os.getpid())}
        environment["PYTHONUNBUFFERED"] = "1"  # the last words in a log are why a run failed
        places = self._places(len(waiting))
        workers = [Worker(self.program, environment, cores) for cores in places]
        try:
            while waiting or any(worker.job for worker in workers):
                for worker in workers:
                    if waiting and worker.job is None:
                        worker.take(waiting.pop(0))
                time.sleep(self.poll_s)
                for worker in workers:
                    result = worker.result()
                    if result is not None and not waiting:
                        worker.ask_to_stop()  # it need not keep its memory to the end of the study
                    if result is not None:
                        yield result
        finally:
            for worker in workers:
                worker.ask_to_stop()
            deadline = time.monotonic() + self.grace_s
            for worker in workers:
                worker.wait(max(0.0, deadline - time.monotonic()))

    def _places(self, jobs: int) -> list[set[int]]:
        """The cores of each worker.

        Fewer workers than cores go where there is room: another study, or shard, may be at work on
        the same machine.
        """
        cores = available_cores()
        if self.workers in (0, len(cores)):
            return [{core} for core in cores]
        return [set(cores)] * min(self.workers, jobs)


class Worker:
    """A place for one run at a time, and the process that carries it out.

    Args:
        program: command line of the process.
        environment: its environment.
        cores: the processor cores it may use.
    """

    job: Job | Command | None
    """The run that is under way."""

    def __init__(
        self, program: Sequence[str], environment: dict[str, str], cores: set[int]
    ) -> None:
        self.job = None
        self._program = program
        self._environment = environment
        self._cores = cores
        self._process: subprocess.Popen[bytes] | None = None
        self._orders: IO[bytes]
        self._answers: IO[bytes]
        self._begun_s = 0.0
        self._runs = 0
        self._has_failed = False

    def take(self, job: Job | Command) -> None:
        """Begin with a run."""
        self.job = job
        job.add_to_log("")
        if self._is_spent() or not self._send(job):
            self.wait(GRACE_S)
            self._start(job)
            self._send(job)
        self._runs += 1

    def result(self) -> JobResult | None:
        """How the run ended; None while it is under way, and where there is none."""
        job = self.job
        process = self._process
        if job is None or process is None:
            return None
        code = process.poll()
        # after that: what it said before it ended counts
        answer = self._answers.read()
        if answer is not None and DONE in answer:
            self.job = None
            return JobResult(job.name)
        self._has_failed |= answer is not None and FAILED in answer
        if code is None:
            return None
        self.job = None
        self.wait(0.0)
        return JobResult(job.name, end_of_worker(code, job.log, self._has_failed))

    def ask_to_stop(self) -> None:
        """Ask the process to end, after it has saved a run that is under way."""
        if self._process is None:
            return
        if self.job is not None:
            self._process.terminate()
        self._orders.close()

    def wait(self, grace_s: float) -> None:
        """Wait until the process has ended, and kill it after a time."""
        process = self._process
        if process is None:
            return
        self._orders.close()
        try:
            process.wait(grace_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._answers.close()
        self._process = None

    def _is_spent(self) -> bool:
        """Whether another process should carry out the next run."""
        seconds = time.monotonic() - self._begun_s
        return self._process is None or self._runs >= MOST_RUNS or seconds >= LONG_S

    def _send(self, job: Job | Command) -> bool:
        """Hand a run to the process; False if the process is no more."""
        order = {"words": job.order, "log": str(job.log)}
        try:
            self._orders.write(json.dumps(order).encode() + b"\n")
        except OSError:
            return False
        return True

    def _start(self, job: Job | Command) -> None:
        """Start a process; what it says before its first run goes into the log of that."""
        with open_append(job.log) as log:
            process = subprocess.Popen(
                self._program,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self._environment,
                bufsize=0,
                # the terminal's Ctrl-C goes to the study alone, which then stops its workers
                start_new_session=True,
            )
        assert process.stdin is not None and process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        if hasattr(os, "sched_setaffinity"):
            # slower without it, not wrong
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.sched_setaffinity(process.pid, self._cores)
        self._process = process
        self._orders = process.stdin
        self._answers = process.stdout
        self._begun_s = time.monotonic()
        self._runs = 0
        self._has_failed = False


def end_of_worker(code: int, log: Path, has_failed: bool = True) -> str:
    """Why a worker ended: its last words, where it said that the run has failed; else the signal or
    the exit code, and what stands last in its log.
    """
    try:
        lines = read_end(log).strip().splitlines()
    except (OSError, ValueError):  # somebody removed it, or put something else in its place
        lines = []
    last = lines[-1].strip().removeprefix("arcade-torch: ") if lines else ""
    if code >= 0 and has_failed:
        return last or f"exit code {code}"
    end = f"ended by signal {-code}" if code < 0 else f"ended without a word (exit code {code})"
    return end + (f"; its log ends with: {last}" if last else "")
