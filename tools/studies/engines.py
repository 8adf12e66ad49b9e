"""Where the runs of a study are carried out: in this process or on a Ray cluster; processes of this
machine stand in `processes`.

An engine takes jobs and yields one result for each as they end. A job is a JSON file, the config of
a run. Progress needs no channel of its own: every run writes ``progress.json`` into its folder.
"""

import contextlib
import getpass
import hashlib
import importlib
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from urllib.parse import urlsplit

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import (
    MOST_JSON,
    MOST_TENSORS,
    is_inside,
    open_append,
    read_bytes,
    read_json,
    write_atomic,
)
from arcade_torch.tools.errors import need, one_line, reason
from arcade_torch.tools.imports import for_workers, imports_of, load_extensions
from arcade_torch.tools.machine import available_cores, keep_freed_memory
from arcade_torch.tools.text import warn

GRACE_S = 60.0
"""How long an interrupted run may take to write its checkpoint before it is killed."""

CONNECT_S = 30.0
"""How long a Ray cluster may take to answer."""

LOST_S = 40.0
"""A Ray cluster that has not answered for so long is lost; after 60 s Ray ends this process."""
LOST_GRACE_S = 5.0
"""How long its runs may take to save, if they can still be reached."""

_NOT_SENT = {"trainer.pt", "replay", "lock"}  # needed only to go on training
_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_DEDUP_LOGS": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}


class Job(NamedTuple):
    """One run to do: its name, JSON file with its config, its folder, and the log for what it
    prints.
    """

    name: str
    config: Path
    folder: Path
    log: Path

    @property
    def words(self) -> list[str]:
        """Options of ``arcade-torch train`` that do it."""
        return ["--config", str(self.config), "--out", str(self.folder), "--resume"]

    @property
    def order(self) -> list[str]:
        """Words of the command line that does it in a worker process."""
        return ["train", *self.words, "--wait", f"{GRACE_S:g}"]

    def train(self) -> None:
        """Carry it out in this process; a run that was begun goes on.

        Raises:
            KeyboardInterrupt: it was interrupted, and has saved.
        """
        from arcade_torch.agents import TrainConfig, train
        from arcade_torch.agents.runs.folder import wait_until_free
        from arcade_torch.tools.memory_files import LateImports

        load_extensions()  # of the process that made the job
        keep_freed_memory()
        wait_until_free(self.folder, GRACE_S)
        config = TrainConfig.from_dict(read_json(self.config))
        late = LateImports(self.folder, config)
        result = train(config, self.folder, True, late, imports=imports_of(config))
        if result.status == "interrupted":
            raise KeyboardInterrupt

    def attempt(self) -> tuple[str, str]:
        """Carry it out; returns why it failed in one line, and the traceback, both empty for
        success.
        """
        try:
            self.train()
        except (Exception, SystemExit) as error:  # a memory model of somebody's may call sys.exit
            return reason(error), traceback.format_exc()
        return "", ""

    def add_to_log(self, text: str) -> None:
        """Add text to the log; its folder is made."""
        add_to_log(self.log, text)


class Command(NamedTuple):
    """A command line to carry out in a worker process, and the log for what it prints."""

    name: str
    order: list[str]
    log: Path

    def add_to_log(self, text: str) -> None:
        """Add text to the log; its folder is made."""
        add_to_log(self.log, text)


def add_to_log(log: Path, text: str) -> None:
    """Add text to a log; its folder is made."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with open_append(log) as stream:
        stream.write(text.encode())


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
        """Run the jobs in order; an exception of one becomes its result, and its traceback goes
        into the log.
        """
        for job in jobs:
            error, trace = job.attempt()
            if trace:
                job.add_to_log(trace)
            yield JobResult(job.name, error)


class ClusterLostError(RuntimeError):
    """The cluster that a study uses is no more; what is finished is kept."""


@dataclass
class RayOptions:
    """How a Ray cluster is used."""

    # Ray: address of a cluster (auto, HOST:PORT); without one, a cluster of its own on this
    # machine.
    address: str = ""
    cpus_per_run: float = 1.0  # Ray: cores that a run keeps busy.
    gpus_per_run: float = 0.0  # Ray: GPUs, or the part of one, that a run keeps busy.
    retries: int = 2  # Ray: further attempts at a run whose process or machine was lost.


@dataclass
class Ray(RayOptions):
    """Carries out runs as tasks of a Ray cluster: one of its own on this machine, or an existing
    one.

    Ray places the runs, and starts one again whose worker or machine was lost; it goes on from its
    last checkpoint. Where a machine sees the study's folder, the run is written there. Where it
    does not, the run is carried out on the disk of that machine and its small files travel back. A
    cluster of its own can be reached from this machine alone and ends with the study.

    Raises:
        ValueError: a number is out of range.
        MissingPackage: ray is not installed.
    """

    workers: int = 0  # Runs at once; 0 for as many as the cluster has room for.
    module: Any = None  # The ray package, imported if it is not given.

    def __post_init__(self) -> None:
        require(self.cpus_per_run > 0, "cpus-per-run", self.cpus_per_run, "above 0")
        least = min(self.gpus_per_run, self.retries)
        require(least >= 0, "gpus-per-run and retries", least, "at least 0")
        self.module = self.module or need("ray")

    def run(self, jobs: Iterable[Job]) -> Iterator[JobResult]:
        """Run the jobs as there is room; on Ctrl-C or close each run gets time to save."""
        with self._cluster() as ray:
            self._check_room(ray)
            options = {
                "num_cpus": self.cpus_per_run,
                "num_gpus": self.gpus_per_run,
                "max_retries": self.retries,
            }
            environment = {"env_vars": for_workers()}
            task = ray.remote(max_calls=1, runtime_env=environment, **options)(carry_out)
            head = _Head(ray.get_runtime_context().gcs_address)
            waiting = list(jobs)
            flying = dict[Any, Job]()
            grace_s = GRACE_S
            try:
                while waiting or flying:
                    while waiting and len(flying) < (self.workers or len(waiting) + len(flying)):
                        job = waiting.pop(0)
                        there = job._replace(
                            config=job.config.absolute(), folder=job.folder.absolute()
                        )
                        flying[task.remote(there, read_bytes(job.config, MOST_JSON))] = job
                    ready, _ = ray.wait(list(flying), num_returns=1, timeout=1.0)
                    # without its head, Ray does not come back from a question about the cluster
                    if head.answers() and not self.address:
                        _check_node(ray)
                    for reference in ready:
                        yield _result(ray, reference, flying.pop(reference))
            except ClusterLostError:
                grace_s = LOST_GRACE_S
                raise
            finally:
                for reference in flying:
                    with contextlib.suppress(Exception):
                        ray.cancel(reference, force=False)  # an interrupt in the task, which saves
                with contextlib.suppress(Exception):
                    ray.wait(list(flying), num_returns=len(flying), timeout=grace_s)

    def _check_room(self, ray: Any) -> None:
        """Refuse a run that is too large for this machine; say so where it is too large for a
        cluster, which another machine may join.
        """
        most = "nothing"
        for node in ray.nodes():
            resources = node["Resources"] if node["Alive"] else {}
            cpus = resources.get("CPU", 0)
            gpus = resources.get("GPU", 0)
            if cpus >= self.cpus_per_run and gpus >= self.gpus_per_run:
                return
            most = f"{cpus:g} and {gpus:g}"
        wanted = f"a run wants {self.cpus_per_run:g} cores and {self.gpus_per_run:g} GPUs"
        if not self.address:
            raise ValueError(
                f"{wanted}, this machine has {most}: lower --cpus-per-run or --gpus-per-run"
            )
        warn(
            f"{wanted}, which no machine of the cluster at {self.address} has: all wait until one "
            "with that joins; if none is to come, stop, and lower --cpus-per-run or --gpus-per-run"
        )

    @contextlib.contextmanager
    def _cluster(self) -> Iterator[Any]:
        """The ray package, connected; a cluster that was there before stays."""
        ray = self.module
        if ray.is_initialized():
            yield ray
            return
        for key, value in _QUIET.items():
            os.environ.setdefault(key, value)
        options: dict[str, Any] = {
            "log_to_driver": False,
            "logging_level": "ERROR",
            "address": self.address or "local",
        }
        if not self.address:
            # Ray replaces 127.0.0.1 by the address that other machines know, and listens there, but
            # for this switch, made for firewalls that ask; it is read from the environment when ray
            # is imported.
            with contextlib.suppress(ImportError, AttributeError):
                ray_constants: Any = importlib.import_module("ray._private.ray_constants")
                ray_constants.ENABLE_RAY_CLUSTER = False
            options |= {
                "num_cpus": max(len(available_cores()), self.workers),
                "include_dashboard": False,
            }
            options |= {"_node_ip_address": "127.0.0.1", "object_store_memory": 128 << 20}
        _check_answers(self.address)
        handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            ray.init(**options)
        except ConnectionError as error:
            raise ValueError(
                f"no Ray cluster answers at {self.address!r}: {error}; if it asks for a token "
                "(InvalidAuthToken), set RAY_AUTH_MODE=token"
            ) from error
        with contextlib.suppress(ValueError):  # not the main thread
            for number, handler in handlers.items():
                signal.signal(number, handler)
        try:
            yield ray
        finally:
            ray.shutdown()


def _check_answers(address: str) -> None:
    """Refuse an address at which nothing listens: Ray tries for many minutes, without a word."""
    try:
        _call(address, CONNECT_S)
    except OSError as error:
        raise ValueError(f"no Ray cluster answers at {address!r}: {error}") from error


def _call(address: str, limit_s: float) -> None:
    """Open a connection and close it; an ``OSError`` if nothing listens there. Of ``auto``, or
    none, nothing is asked.
    """
    url = urlsplit(address if "://" in address else f"//{address}")
    if url.port is not None:
        socket.create_connection((url.hostname or "", url.port), limit_s).close()


class _Head:
    """The process of a Ray cluster that all others are connected to.

    One that cannot be reached from this machine at the beginning, such as through a client's port,
    is not asked.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._answered_s = time.monotonic()
        self._is_asked = self._can_be_called()

    def answers(self) -> bool:
        """Whether it answers now.

        Raises:
            ClusterLostError: it has not for `LOST_S`.
        """
        if not self._is_asked or self._can_be_called():
            self._answered_s = time.monotonic()
            return True
        silent_s = time.monotonic() - self._answered_s
        if silent_s > LOST_S:
            raise ClusterLostError(
                f"the Ray cluster, whose head was at {self._address}, has not answered for "
                f"{silent_s:.0f} s; finished runs are kept, the same command, with a cluster that "
                "answers, goes on with the others"
            )
        return False

    def _can_be_called(self) -> bool:
        try:
            _call(self._address, LOST_GRACE_S)
        except OSError:
            return False
        return True


def _check_node(ray: Any) -> None:
    """Raise if the one machine of a cluster of our own, which began with all cores, is gone."""
    if not ray.cluster_resources().get("CPU"):
        raise ClusterLostError(
            "Ray's node on this machine is gone (killed, or out of memory); finished runs are "
            "kept, the same command goes on with the others"
        )


def carry_out(job: Job, config: bytes) -> tuple[str, str, dict[str, bytes]]:
    """Carry out a run on a machine of the cluster.

    The paths of the job are those of the machine that sends it. Returns why the run failed, in one
    line, and the traceback (empty for success), and where the disk is not shared its small files:
    of a failed run no checkpoints.
    """
    shared = False
    files = dict[str, bytes]()
    command = ["arcade-torch", "train", *job.words]
    with contextlib.suppress(OSError, ValueError):
        shared = read_bytes(job.config, MOST_JSON) == config
    if not shared:
        # another attempt finds it again
        key = hashlib.sha256(f"{job.config}".encode() + config).hexdigest()[:16]
        disk = Path(tempfile.gettempdir()) / f"arcade-torch-{getpass.getuser()}"
        folder = disk / f"{job.name}-{key}"
        file = write_atomic(folder / "config.json", config)
        job = job._replace(folder=folder / "run", config=file)
    with _hearing_cancel(), _called(command):
        error, trace = job.attempt()
    if not shared:
        kept = _NOT_SENT | ({"checkpoints"} if error else set())
        for path in job.folder.rglob("*"):
            name = path.relative_to(job.folder)
            if path.is_file() and not path.is_symlink() and not kept & set(name.parts):
                files[name.as_posix()] = read_bytes(path, MOST_TENSORS)
        if not error:
            shutil.rmtree(job.config.parent)
    return error, trace, files


@contextlib.contextmanager
def _called(command: list[str]) -> Iterator[None]:
    """Let a run note this command as its beginning: that of Ray's worker says how to reach the
    cluster, and not how to repeat the run.
    """
    before = sys.argv
    sys.argv = command
    try:
        yield
    finally:
        sys.argv = before


@contextlib.contextmanager
def _hearing_cancel() -> Iterator[None]:
    """Let SIGINT, by which Ray cancels a task, be heard.

    A study that a script started in the background ignores it, and its workers inherit that.
    """
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if not ignored or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _result(ray: Any, reference: Any, job: Job) -> JobResult:
    """What came of a task; writes what travelled back, the final evaluation last."""
    try:
        error, trace, files = ray.get(reference)
    except ray.exceptions.RayError as lost:
        return JobResult(
            job.name, f"its worker was lost: {type(lost).__name__}: {one_line(lost)[:200]}"
        )
    for name in files:
        if not is_inside(job.folder, name):
            return JobResult(job.name, f"its worker sent {name!r}, which is no file of a run")
    for name in sorted(files, key=lambda name: name == "eval.json"):
        write_atomic(job.folder / name, files[name])
    job.add_to_log(trace)
    return JobResult(job.name, error)
