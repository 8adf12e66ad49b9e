"""Runs of a study on a Ray cluster: one of its own on this machine, or an existing one.

Ray places the runs, and starts one again whose worker or machine was lost; it goes on from its last checkpoint. Where
a machine sees the study's folder, the run is written there. Where it does not, the run is carried out on the disk of
that machine and its small files travel back.
"""

import contextlib
import getpass
import hashlib
import importlib
import os
import shutil
import signal
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from arcade_torch.tools.errors import one_line, reason
from arcade_torch.tools.extensions import VARIABLE, load_extensions
from arcade_torch.tools.files import write_bytes
from arcade_torch.tools.optional import need
from arcade_torch.tools.studies.engines import GRACE_S, Job, JobResult, available_cores

_NOT_SENT = {"trainer.pt", "replay", "lock"}  # needed only to go on training
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}


class ClusterLostError(RuntimeError):
    """The cluster that a study started for itself is no more; what is finished is kept."""


@dataclass
class Ray:
    """Carries out runs as tasks of a Ray cluster.

    Attributes:
        workers: runs at once; 0 for as many as the cluster has room for.
        address: of a cluster, ``auto`` or ``HOST:PORT``; empty starts one on this machine that only this machine can
            reach and that ends with the study.
        cpus_per_run: cores a run keeps busy.
        gpus_per_run: GPUs, or the part of one, a run keeps busy.
        retries: further attempts at a run whose worker or machine was lost.
        module: the ray package, imported when needed.
    """

    workers: int = 0
    address: str = ""
    cpus_per_run: float = 1
    gpus_per_run: float = 0
    retries: int = 2
    module: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: one is out of range.
            MissingPackage: ray is not installed.
        """
        if self.cpus_per_run <= 0:
            raise ValueError(f"cpus-per-run must be above 0, got {self.cpus_per_run}")
        if self.gpus_per_run < 0 or self.retries < 0:
            raise ValueError(f"gpus-per-run and retries must be at least 0, got {self.gpus_per_run}, {self.retries}")
        self.module = self.module or need("ray")

    def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
        """Run the jobs as there is room; on Ctrl-C or close each run gets time to save."""
        with self._cluster() as ray:
            have = ray.cluster_resources()
            cpus, gpus = have.get("CPU", 0), have.get("GPU", 0)
            if not self.address and (cpus < self.cpus_per_run or gpus < self.gpus_per_run):
                wanted = f"a run wants {self.cpus_per_run:g} cores and {self.gpus_per_run:g} GPUs, this machine has"
                raise ValueError(f"{wanted} {cpus:g} and {gpus:g}: lower --cpus-per-run or --gpus-per-run")
            options = {"num_cpus": self.cpus_per_run, "num_gpus": self.gpus_per_run, "max_retries": self.retries}
            environment = {"env_vars": {VARIABLE: os.environ.get(VARIABLE, "")}}
            task = ray.remote(max_calls=1, runtime_env=environment, **options)(carry_out)
            waiting, flying = list(jobs), dict[Any, Job]()
            try:
                while waiting or flying:
                    while waiting and len(flying) < (self.workers or len(waiting) + len(flying)):
                        job = waiting.pop(0)
                        there = job._replace(config=job.config.absolute(), folder=job.folder.absolute())
                        flying[task.remote(there, job.config.read_bytes())] = job
                    ready, _ = ray.wait(list(flying), num_returns=1, timeout=1.0)
                    if not self.address and not ray.cluster_resources().get("CPU"):  # it began with all cores
                        raise ClusterLostError(
                            "Ray's node on this machine is gone (killed, or out of memory); finished runs are kept, "
                            "the same command goes on with the others"
                        )
                    for reference in ready:
                        yield _result(ray, reference, flying.pop(reference))
            finally:
                for reference in flying:
                    with contextlib.suppress(Exception):
                        ray.cancel(reference, force=False)  # an interrupt in the task, which saves
                with contextlib.suppress(Exception):
                    ray.wait(list(flying), num_returns=len(flying), timeout=GRACE_S)

    @contextlib.contextmanager
    def _cluster(self) -> Iterator[Any]:
        """The ray package, connected; a cluster that was there before stays."""
        ray = self.module
        if ray.is_initialized():
            yield ray
            return
        for key, value in _QUIET.items():
            os.environ.setdefault(key, value)
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "address": self.address or "local"}
        if not self.address:
            # Ray replaces 127.0.0.1 by the address that other machines know, and listens there, but for this switch,
            # made for firewalls that ask; it is read from the environment when ray is imported.
            with contextlib.suppress(ImportError, AttributeError):
                importlib.import_module("ray._private.ray_constants").ENABLE_RAY_CLUSTER = False  # type: ignore[attr-defined]
            options |= {"num_cpus": max(len(available_cores()), self.workers), "include_dashboard": False}
            options |= {"_node_ip_address": "127.0.0.1", "object_store_memory": 128 << 20}
        handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
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


def carry_out(job: Job, config: bytes) -> tuple[str, str, dict[str, bytes]]:
    """Carry out a run on a machine of the cluster.

    The paths of the job are those of the machine that sends it. Returns why the run failed, in one line, and the
    traceback (empty for success), and the content of its small files where the disk is not shared.
    """
    shared, files = False, dict[str, bytes]()
    with contextlib.suppress(OSError):
        shared = job.config.read_bytes() == config
    if not shared:
        key = hashlib.sha256(f"{job.config}".encode() + config).hexdigest()[:16]  # another attempt finds it again
        here = Path(tempfile.gettempdir()) / f"arcade-torch-{getpass.getuser()}" / f"{job.name}-{key}"
        job = job._replace(folder=here / "run", config=write_bytes(here / "config.json", config))
    error = trace = ""
    try:
        load_extensions()
        job.train()
    except Exception as caught:
        error, trace = reason(caught), traceback.format_exc()
    if not shared:
        for path in (path for path in job.folder.rglob("*") if path.is_file()):
            name = path.relative_to(job.folder)
            if not _NOT_SENT & set(name.parts):
                files[name.as_posix()] = path.read_bytes()
        if not error:
            shutil.rmtree(job.config.parent)
    return error, trace, files


def _result(ray: Any, reference: Any, job: Job) -> JobResult:
    """What came of a task; writes what travelled back, the final evaluation last."""
    try:
        error, trace, files = ray.get(reference)
    except ray.exceptions.RayError as lost:
        return JobResult(job.name, f"its worker was lost: {type(lost).__name__}: {one_line(lost)[:200]}")
    for name in sorted(files, key=lambda name: name == "eval.json"):
        write_bytes(job.folder / name, files[name])
    job.add_to_log(trace)
    return JobResult(job.name, error)
