"""Runs of a study on a Ray cluster: one of its own on this machine, or an existing one.

A Ray task starts the very command that a worker process of this machine would get, so a run does the same anywhere.
Where the machine that got the task sees the study's folder, the run is written there. Where it does not, the run is
carried out in a folder of that machine and its small files travel back.
"""

import contextlib
import importlib
import os
import signal
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from arcade_torch.tools.extensions import VARIABLE
from arcade_torch.tools.files import write_bytes
from arcade_torch.tools.optional import need
from arcade_torch.tools.studies.engines import Job, JobResult, Jobs, available_cores
from arcade_torch.tools.studies.ray_task import Order, Outcome, carry_out

OBJECT_STORE_BYTES = 128 << 20
PROBE_DAYS = 7
"""Older files named .shared-... are litter: left by studies that were killed."""
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}


class ClusterLostError(RuntimeError):
    """The cluster that a study started for itself is no more; what is finished is kept."""


@dataclass
class _Attempt:
    order: Order
    number: int


@dataclass
class Ray:
    """Carries out runs as tasks of a Ray cluster.

    Attributes:
        workers: runs at once; 0 for as many as the cluster has room for.
        address: of a cluster, ``auto`` or ``HOST:PORT``; empty starts one on this machine that only this machine can
            reach and that ends with the study.
        cpus_per_run: cores a run keeps busy.
        gpus_per_run: GPUs, or the part of one, a run keeps busy.
        retries: further attempts at a run whose process or machine was lost; it goes on from its last checkpoint.
        module: the ray package, imported when needed.
        poll_s: seconds between two looks.
    """

    workers: int = 0
    address: str = ""
    cpus_per_run: float = 1
    gpus_per_run: float = 0
    retries: int = 2
    module: Any = field(default=None, repr=False)
    poll_s: float = 0.2

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: one is out of range.
            MissingPackage: ray is not installed.
        """
        if self.workers < 0:
            raise ValueError(f"workers must be at least 1 (or 0 for what the cluster has room for), got {self.workers}")
        if self.cpus_per_run <= 0:
            raise ValueError(f"cpus-per-run must be above 0, got {self.cpus_per_run}")
        if self.gpus_per_run < 0 or self.retries < 0:
            raise ValueError(f"gpus-per-run and retries must be at least 0, got {self.gpus_per_run}, {self.retries}")
        if not self.address:
            os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        self.module = self.module or need("ray")

    def run(self, jobs: Jobs) -> Iterator[JobResult]:
        """Run the jobs as there is room; on Ctrl-C or close each run gets time to save."""
        with self._cluster() as ray:
            task = ray.remote(num_cpus=self.cpus_per_run, num_gpus=self.gpus_per_run, max_retries=0)(carry_out)
            probes: dict[Path, str] = {}
            flying: dict[Any, _Attempt] = {}
            try:
                yield from self._loop(ray, task, jobs, probes, flying)
            finally:
                _cancel(ray, list(flying))
                for file in probes:
                    file.unlink(missing_ok=True)

    def _loop(
        self, ray: Any, task: Any, jobs: Jobs, probes: dict[Path, str], flying: dict[Any, _Attempt]
    ) -> Iterator[JobResult]:
        waiting, more = iter(jobs), True
        while more or flying:
            room = self._room(ray)
            while more and len(flying) < room:
                try:
                    job = next(waiting)
                except StopIteration:
                    more = False
                    break
                if job is None:
                    break
                order = _order(job, probes, max(1, int(self.cpus_per_run)))
                flying[task.remote(order)] = _Attempt(order, 0)
            if not flying:
                time.sleep(self.poll_s)
                continue
            ready, _ = ray.wait(list(flying), num_returns=1, timeout=self.poll_s)
            for reference in ready:
                attempt = flying.pop(reference)
                outcome = _outcome(ray, reference)
                _keep(attempt.order, outcome)
                if outcome.lost and attempt.number < self.retries:
                    flying[task.remote(attempt.order)] = _Attempt(attempt.order, attempt.number + 1)
                    continue
                tried = f" (attempt {attempt.number + 1})" if attempt.number else ""
                yield JobResult(attempt.order.name, outcome.exit_code, outcome.error and outcome.error + tried)

    def _room(self, ray: Any) -> int:
        """Runs that the cluster has room for now; machines may come and go. One more on a cluster that can grow."""
        have = ray.cluster_resources()
        if not self.address and not have.get("CPU"):  # it began with all cores of this machine
            raise ClusterLostError(
                "Ray's node on this machine is gone (killed, or out of memory); finished runs are kept, "
                "the same command goes on with the others"
            )
        room = int(have.get("CPU", 0) / self.cpus_per_run)
        if self.gpus_per_run:
            room = min(room, int(have.get("GPU", 0) / self.gpus_per_run))
        if not self.address and room < 1:
            raise ValueError(
                f"a run wants {self.cpus_per_run:g} cores and {self.gpus_per_run:g} GPUs, this machine has "
                f"{have.get('CPU', 0):g} and {have.get('GPU', 0):g}: lower --cpus-per-run or --gpus-per-run"
            )
        room = room if not self.address else room + 1
        return min(room, self.workers) if self.workers else room

    @contextlib.contextmanager
    def _cluster(self) -> Iterator[Any]:
        """The ray package, connected; a cluster that was there before stays."""
        ray = self.module
        if ray.is_initialized():
            yield ray
            return
        for key, value in _QUIET.items():
            os.environ.setdefault(key, value)
        handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        if self.address:
            options["address"] = self.address
        else:
            options |= {
                "address": "local",
                "num_cpus": max(len(available_cores()), self.workers),
                "include_dashboard": False,
                "_node_ip_address": "127.0.0.1",
                "object_store_memory": OBJECT_STORE_BYTES,
            }
        if not self.address:
            _stay_on_loopback()
        try:
            ray.init(**options)
        except ConnectionError as error:
            raise ValueError(f"no Ray cluster answers at {self.address!r}: {error}") from error
        with contextlib.suppress(ValueError):  # not the main thread
            for number, handler in handlers.items():
                signal.signal(number, handler)
        try:
            yield ray
        finally:
            ray.shutdown()


def _stay_on_loopback() -> None:
    """Keep ray from replacing 127.0.0.1 by the address that other machines know, at which it would then listen.

    Ray has one switch for this, made for firewalls that ask; it is read from the environment when ray is imported.
    """
    with contextlib.suppress(ImportError, AttributeError):
        constants: Any = importlib.import_module("ray._private.ray_constants")
        constants.ENABLE_RAY_CLUSTER = False


def _order(job: Job, probes: dict[Path, str], threads: int) -> Order:
    """What a machine is told: absolute paths, and a file by which it sees whether it shares the disk."""
    folder = job.folder.absolute() if job.folder is not None else None
    words = tuple(str(folder) if word == str(job.folder) else word for word in job.words)
    root = folder.parent if folder is not None else job.log.absolute().parent
    probe = next((file for file in probes if file.parent == root), None)
    if probe is None:
        _sweep(root)
        probe = root / f".shared-{uuid.uuid4().hex}"
        probes[probe] = uuid.uuid4().hex
        write_bytes(probe, probes[probe].encode())
    environment = {name: str(threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    environment |= {VARIABLE: os.environ[VARIABLE]} if VARIABLE in os.environ else {}
    return Order(job.name, words, job.log.absolute(), folder, (probe, probes[probe]), environment)


def _sweep(root: Path) -> None:
    """Remove the files by which studies that were killed showed their disk; younger ones may still be needed."""
    for old in root.glob(".shared-*"):
        with contextlib.suppress(OSError):
            if time.time() - old.stat().st_mtime > PROBE_DAYS * 86_400:
                old.unlink()


def _outcome(ray: Any, reference: Any) -> Outcome:
    """What came of a task; a lost machine or worker is an outcome too."""
    try:
        outcome: Outcome = ray.get(reference)
        return outcome
    except ray.exceptions.RayTaskError as error:
        return Outcome(1, f"{type(error).__name__}: {' '.join(str(error.cause or error).split())}")
    except ray.exceptions.RayError as error:
        words = " ".join(str(error).split()) or "no details"
        return Outcome(-1, f"its worker was lost: {type(error).__name__}: {words[:200]}", lost=True)


def _keep(order: Order, outcome: Outcome) -> None:
    """Write what came back from a machine that does not share the disk; the final evaluation last."""
    if order.folder is None:
        return
    for name, data in sorted(outcome.files.items(), key=lambda item: item[0] == "eval.json"):
        target = (order.folder / name).resolve()
        if order.folder.resolve() in target.parents:
            write_bytes(target, data)
    if outcome.log:
        order.log.parent.mkdir(parents=True, exist_ok=True)
        with order.log.open("ab") as stream:
            stream.write(outcome.log)


def _cancel(ray: Any, references: list[Any]) -> None:
    """Ask what still runs to save and stop, and wait for it."""
    from arcade_torch.tools.studies.engines import GRACE_S

    for reference in references:
        with contextlib.suppress(Exception):
            ray.cancel(reference, force=False)
    if references:
        with contextlib.suppress(Exception):
            ray.wait(references, num_returns=len(references), timeout=GRACE_S)
