"""Runs on a Ray cluster: what the engine makes of lost workers and foreign disks, and the real thing."""

import io
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from arcade_torch.agents.lease import LOCK, Lease
from arcade_torch.tools.studies import ray_task
from arcade_torch.tools.studies.engines import Job, JobResult, Processes
from arcade_torch.tools.studies.ray_engine import ClusterLostError, Ray
from arcade_torch.tools.studies.ray_task import Order, Outcome, carry_out
from arcade_torch.tools.studies.runner import study
from tests.tools.fabricated import small_study


class RayError(Exception):
    """As in ray.exceptions."""


class FakeRay:
    """As much of the ray package as the engine uses; a task is done when it is asked for."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=type("RayTaskError", (RayError,), {"cause": None}))

    def __init__(self, do: Callable[[Order], Outcome], cores: int = 2) -> None:
        self.do, self.cores, self.most, self.flying, self.cancelled = do, cores, 0, dict[int, Order](), list[int]()
        self.count = 0

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self.cores}

    def remote(self, **options: Any) -> Callable[[Any], Any]:
        def send(order: Order) -> int:
            self.count += 1
            self.flying[self.count] = order
            self.most = max(self.most, len(self.flying))
            return self.count

        return lambda function: SimpleNamespace(remote=send)

    def wait(self, references: Sequence[int], **options: Any) -> tuple[list[int], list[int]]:
        return list(references[:1]), list(references[1:])

    def get(self, reference: int) -> Outcome:
        return self.do(self.flying.pop(reference))

    def cancel(self, reference: int, force: bool) -> None:
        assert not force
        self.cancelled.append(reference)


def some_jobs(tmp_path: Path, count: int = 3) -> list[Job]:
    folders = [tmp_path / "s" / "runs" / f"run{index}" for index in range(count)]
    return [Job(f.name, ("train", "--out", str(f), "--resume"), tmp_path / f"{f.name}.log", f) for f in folders]


def run_all(ray: FakeRay, jobs: Sequence[Job], **options: Any) -> dict[str, JobResult]:
    return {result.name: result for result in Ray(module=ray, poll_s=0.0, **options).run(jobs)}


def test_no_more_runs_are_sent_than_the_cluster_has_room_for(tmp_path: Path) -> None:
    for options, most in (({}, 4), ({"cpus_per_run": 2}, 2), ({"workers": 1}, 1)):
        ray = FakeRay(lambda order: Outcome(0), cores=4)
        results = run_all(ray, some_jobs(tmp_path, 6), **options)
        assert len(results) == 6 and ray.most == most


def test_a_lost_worker_is_tried_again_and_a_failed_run_is_not(tmp_path: Path) -> None:
    seen: list[str] = []

    def do(order: Order) -> Outcome:
        seen.append(order.name)
        if order.name == "run0" and seen.count("run0") < 3:
            raise RayError("the machine is gone")
        if order.name == "run1":
            return Outcome(1, "loss is NaN")
        return Outcome(-9, "killed", lost=True) if order.name == "run2" else Outcome(0)

    results = run_all(FakeRay(do), some_jobs(tmp_path))
    assert [seen.count(f"run{index}") for index in range(3)] == [3, 1, 3]
    assert [results[f"run{index}"].exit_code for index in range(3)] == [0, 1, -9]
    assert results["run1"].error == "loss is NaN" and results["run2"].error == "killed (attempt 3)"
    assert len(run_all(FakeRay(do), some_jobs(tmp_path)[2:], retries=0)) == 1 and seen.count("run2") == 4


def test_closing_the_engine_cancels_what_still_runs(tmp_path: Path) -> None:
    ray = FakeRay(lambda order: Outcome(0), cores=3)
    results = Ray(module=ray, poll_s=0.0).run(some_jobs(tmp_path))
    next(results)
    results.close()  # type: ignore[attr-defined]
    assert ray.cancelled == [2, 3]
    assert not list((tmp_path / "s" / "runs").glob(".shared*"))


def test_what_a_killed_study_left_is_swept_away_a_week_later(tmp_path: Path) -> None:
    runs = tmp_path / "s" / "runs"
    runs.mkdir(parents=True)
    old, young = runs / ".shared-old", runs / ".shared-young"
    for file in (old, young):
        file.touch()
    os.utime(old, (time.time() - 8 * 86_400,) * 2)
    run_all(FakeRay(lambda order: Outcome(0)), some_jobs(tmp_path))
    assert not old.exists() and young.exists()


def test_a_run_that_no_machine_can_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="wants 4 cores and 0 GPUs, this machine has 2 and 0"):
        run_all(FakeRay(lambda order: Outcome(0)), some_jobs(tmp_path), cpus_per_run=4)
    with pytest.raises(ValueError, match="cpus-per-run must be above 0"):
        Ray(module=FakeRay(lambda order: Outcome(0)), cpus_per_run=0)


def test_a_cluster_that_is_gone_is_said_to_be_gone_and_results_are_kept(tmp_path: Path) -> None:
    ray = FakeRay(lambda order: Outcome(0), cores=2)
    results = Ray(module=ray, poll_s=0.0).run(some_jobs(tmp_path, 4))
    assert next(results).exit_code == 0
    ray.cores = 0  # what Ray tells when the only node died
    with pytest.raises(ClusterLostError, match="finished runs are kept"):
        list(results)


PROGRAM = (
    "import pathlib, sys; at = pathlib.Path(sys.argv[sys.argv.index('--out') + 1])\n"
    "saved = ('checkpoints/frames-1/weights.safetensors', 'checkpoints/frames-1/trainer.pt')\n"
    "for name in ('eval.json', *saved, 'lock/x'):\n"
    "    (at / name).parent.mkdir(parents=True, exist_ok=True); (at / name).write_text(name)\n"
    "print('trained in', at)"
)


@pytest.fixture
def _small_program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def engine(workers: int, **options: Any) -> Processes:
        return Processes(workers, program=(sys.executable, "-c", PROGRAM), poll_s=0.02, **options)

    monkeypatch.setattr(ray_task, "Processes", engine)
    monkeypatch.setattr(ray_task.tempfile, "gettempdir", lambda: str(tmp_path / "far"))


@pytest.mark.usefixtures("_small_program")
def test_where_the_disk_is_shared_the_run_is_written_there(tmp_path: Path) -> None:
    assert run_all(FakeRay(carry_out), some_jobs(tmp_path, 1))["run0"].exit_code == 0
    assert (tmp_path / "s/runs/run0/checkpoints/frames-1/trainer.pt").exists()
    assert not (tmp_path / "far").exists()


@pytest.mark.usefixtures("_small_program")
def test_another_attempt_waits_until_the_training_of_the_lost_one_has_stopped(tmp_path: Path) -> None:
    before = Lease(tmp_path / "s/runs/run0" / LOCK)
    assert before.try_take()
    stopped: list[int] = []
    threading.Timer(0.3, lambda: (stopped.append(time.time_ns()), before.release())).start()
    assert run_all(FakeRay(carry_out), some_jobs(tmp_path, 1))["run0"].exit_code == 0
    assert stopped and (tmp_path / "s/runs/run0/eval.json").stat().st_mtime_ns > stopped[0]


@pytest.mark.usefixtures("_small_program")
def test_where_the_disk_is_not_shared_the_small_files_travel_back(tmp_path: Path) -> None:
    def elsewhere(order: Order) -> Outcome:
        return carry_out(replace(order, probe=(tmp_path / "nowhere", order.probe[1])))

    assert run_all(FakeRay(elsewhere), some_jobs(tmp_path, 1))["run0"].exit_code == 0
    run = tmp_path / "s" / "runs" / "run0"
    found = sorted(path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file())
    assert found == ["checkpoints/frames-1/weights.safetensors", "eval.json"]
    assert f"trained in {tmp_path / 'far'}" in (tmp_path / "run0.log").read_text()
    assert not list((tmp_path / "far").rglob("*.json"))


@pytest.mark.ray
@pytest.mark.slow
def test_a_study_on_a_cluster_of_its_own_equals_one_in_this_process_and_listens_to_this_machine_only(
    tmp_path: Path,
) -> None:
    what = small_study(games=["SignpostEasy"], memories=["mlp"], seeds=1, total_frames=512)
    import ray

    listening: list[str] = []
    wait = ray.wait

    def spy(*args: Any, **options: Any) -> Any:
        listening.extend(listeners(os.getpid()))
        return wait(*args, **options)

    engine = Ray()
    engine.module = SimpleNamespace(**{name: getattr(ray, name) for name in dir(ray)} | {"wait": spy})
    results = study(what, tmp_path / "ray", engine, stream=io.StringIO())
    assert results.finished == 2 and not ray.is_initialized()
    assert study(what, tmp_path / "inline", "inline", stream=io.StringIO()).finished == 2
    assert (tmp_path / "ray/results.csv").read_bytes() == (tmp_path / "inline/results.csv").read_bytes()
    if Path("/proc/net/tcp").exists():
        assert len(listening) > 3 and all(is_loopback(address) for address in listening), set(listening)


def is_loopback(address: str) -> bool:
    """Of an address as the kernel writes it."""
    return address.endswith("7F") or address == "00000000000000000000000001000000"


def listeners(pid: int) -> list[str]:
    """Addresses on which a process and its descendants accept connections."""
    sockets: set[str] = set()
    for process in descendants(pid):
        for entry in Path(f"/proc/{process}/fd").glob("*"):
            try:
                sockets.add(os.readlink(entry))
            except OSError:
                continue
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            cells = line.split()
            if cells[3] == "0A" and f"socket:[{cells[9]}]" in sockets:
                found.append(cells[1].partition(":")[0])
    return found


def descendants(pid: int) -> list[int]:
    """A process and all below it."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(entry.parent.name)] = int(entry.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found = [pid]
    for at in found:
        found += [child for child, parent in parents.items() if parent == at]
    return found
