"""Runs on a Ray cluster: what the engine makes of lost workers and foreign disks, and the real
thing.
"""

import _thread
import io
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from arcade_torch.tools.studies import engines
from arcade_torch.tools.studies.engines import ClusterLostError, Job, JobResult, Ray, carry_out
from arcade_torch.tools.studies.runner import study
from tests.tools.fabricated import small_study


class RayError(Exception):
    """As in ray.exceptions."""


class FakeRay:
    """As much of the ray package as the engine uses; a task is done when it is asked for."""

    exceptions = SimpleNamespace(RayError=RayError)

    def __init__(self, do: Callable[[Job, bytes], Any], cores: int = 2) -> None:
        self.do, self.cores, self.most = do, cores, 0
        self.flying, self.cancelled, self.options = dict[int, Any](), list[int](), dict[str, Any]()
        self.count = 0
        self.head = "auto"  # no address that could be called

    def get_runtime_context(self) -> Any:
        return SimpleNamespace(gcs_address=self.head)

    def nodes(self) -> list[dict[str, Any]]:
        lost = {"Alive": False, "Resources": {"CPU": 64.0}}
        return [lost, {"Alive": True, "Resources": {"CPU": self.cores}}]

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self.cores}

    def remote(self, **options: Any) -> Callable[[Any], Any]:
        def send(*task: Any) -> int:
            self.count += 1
            self.flying[self.count] = task
            self.most = max(self.most, len(self.flying))
            return self.count

        self.options = options
        return lambda function: SimpleNamespace(remote=send)

    def wait(self, references: Sequence[int], **options: Any) -> tuple[list[int], list[int]]:
        return list(references[:1]), list(references[1:])

    def get(self, reference: int) -> Any:
        return self.do(*self.flying.pop(reference))

    def cancel(self, reference: int, force: bool) -> None:
        assert not force
        self.cancelled.append(reference)


def fine(job: Job, config: bytes) -> tuple[str, str, dict[str, bytes]]:
    return "", "", {}


def some_jobs(tmp_path: Path, count: int = 3) -> list[Job]:
    found = []
    for name in (f"run{index}" for index in range(count)):
        (tmp_path / f"{name}.json").write_text(f'{{"name": "{name}"}}')
        found.append(
            Job(name, tmp_path / f"{name}.json", tmp_path / "runs" / name, tmp_path / f"{name}.log")
        )
    return found


def run_all(ray: FakeRay, jobs: Sequence[Job], **options: Any) -> dict[str, JobResult]:
    return {result.name: result for result in Ray(module=ray, **options).run(jobs)}


def test_ray_places_all_runs_itself_and_workers_limits_them(tmp_path: Path) -> None:
    for options, most in (({}, 6), ({"workers": 2}, 2)):
        ray = FakeRay(fine, cores=4)
        assert len(run_all(ray, some_jobs(tmp_path, 6), **options)) == 6 and ray.most == most
    run_all(ray, some_jobs(tmp_path), cpus_per_run=2, gpus_per_run=0, retries=7)
    asked = {key: ray.options[key] for key in ("num_cpus", "num_gpus", "max_retries", "max_calls")}
    assert asked == {"num_cpus": 2, "num_gpus": 0, "max_retries": 7, "max_calls": 1}


def test_a_failed_run_leaves_its_reason_and_traceback_and_a_lost_worker_is_named(
    tmp_path: Path,
) -> None:
    def do(job: Job, config: bytes) -> tuple[str, str, dict[str, bytes]]:
        if job.name == "run0":
            raise RayError("the machine\nis gone")
        return ("loss is NaN", "Traceback ...", {}) if job.name == "run1" else fine(job, config)

    results = run_all(FakeRay(do), some_jobs(tmp_path))
    found = [results[f"run{index}"].error for index in range(3)]
    assert found == ["its worker was lost: RayError: the machine is gone", "loss is NaN", ""]
    assert (tmp_path / "run1.log").read_text() == "Traceback ..."


def test_closing_the_engine_cancels_what_still_runs(tmp_path: Path) -> None:
    ray = FakeRay(fine, cores=3)
    results = Ray(module=ray).run(some_jobs(tmp_path))
    next(results)
    results.close()  # type: ignore[attr-defined]
    assert ray.cancelled == [2, 3]


def test_a_run_that_no_machine_can_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="wants 4 cores and 0 GPUs, this machine has 2 and 0"):
        run_all(FakeRay(fine), some_jobs(tmp_path), cpus_per_run=4)
    with pytest.raises(ValueError, match="wants 1 cores and 1 GPUs, this machine has 2 and 0"):
        run_all(FakeRay(fine), some_jobs(tmp_path), gpus_per_run=1)
    with pytest.raises(ValueError, match="cpus-per-run must be above 0"):
        Ray(module=FakeRay(fine), cpus_per_run=0)


@pytest.mark.parametrize(
    ("options", "wants"),
    [({"cpus_per_run": 4}, "4 cores and 0 GPUs"), ({"gpus_per_run": 0.5}, "1 cores and 0.5 GPUs")],
)
def test_a_cluster_on_which_no_machine_can_hold_a_run_is_said_to_be_waited_for(
    options: dict[str, Any], wants: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its runs waited for ever, without a word; the lost machine's 64 cores are none."""
    run_all(FakeRay(fine), some_jobs(tmp_path), address="auto", **options)
    said = capsys.readouterr().err
    assert said.startswith(f"a run wants {wants}, which no machine of the cluster at auto has")
    assert said.count("\n") == 1
    run_all(FakeRay(fine), some_jobs(tmp_path), address="auto")
    assert not capsys.readouterr().err


@pytest.mark.parametrize("address", ["", "auto"])
def test_a_cluster_whose_head_is_gone_is_lost_after_a_time(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a minute Ray ended the whole study, without a table and without a word of how to go
    on. Until then it did not come back from a question about the cluster.
    """

    def ask() -> dict[str, float]:
        raise AssertionError("asked a cluster without a head")

    ray = FakeRay(fine)
    with socket.create_server(("127.0.0.1", 0)) as server:
        ray.head = f"127.0.0.1:{server.getsockname()[1]}"
        results = Ray(module=ray, address=address).run(some_jobs(tmp_path, 4))
        assert next(results).error == ""
    monkeypatch.setattr(ray, "cluster_resources", ask)
    assert next(results).error == ""  # it may come back
    monkeypatch.setattr(engines, "LOST_S", 0.0)
    with pytest.raises(ClusterLostError, match=f"at {ray.head}, has not answered for 0 s; finish"):
        next(results)
    assert ray.cancelled == [3, 4]


def test_a_head_that_cannot_be_reached_from_here_is_not_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client of ``ray://HOST:PORT`` sees that port alone."""
    monkeypatch.setattr(engines, "LOST_S", 0.0)
    ray = FakeRay(fine)
    with socket.create_server(("127.0.0.1", 0)) as server:
        ray.head = f"127.0.0.1:{server.getsockname()[1]}"
    assert len(run_all(ray, some_jobs(tmp_path), address="auto")) == 3


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_at_which_nothing_listens_is_refused_at_once(
    tmp_path: Path, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray tried for more than nine minutes, without a word."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    ray = FakeRay(fine)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with pytest.raises(ValueError, match=f"no Ray cluster answers at '{scheme}127.0.0.1:{port}'"):
        run_all(ray, some_jobs(tmp_path), address=f"{scheme}127.0.0.1:{port}")


def test_a_cluster_that_is_gone_is_said_to_be_gone_and_results_are_kept(tmp_path: Path) -> None:
    ray = FakeRay(fine, cores=2)
    results = Ray(module=ray).run(some_jobs(tmp_path, 4))
    assert next(results).error == ""
    ray.cores = 0  # what Ray tells when the only node died
    with pytest.raises(ClusterLostError, match="finished runs are kept"):
        list(results)


@pytest.fixture
def _small_training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def train(job: Job) -> None:
        names = (
            "eval.json",
            "checkpoints/frames-1/weights.safetensors",
            "checkpoints/frames-1/trainer.pt",
            "lock",
        )
        for name in (*names, "replay/x"):
            (job.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (job.folder / name).write_text(str(job.config.read_bytes()))

    monkeypatch.setattr(Job, "train", train)
    monkeypatch.setattr(engines.tempfile, "gettempdir", lambda: str(tmp_path / "far"))


def test_a_run_notes_the_command_that_repeats_it_and_not_that_of_rays_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noted: list[str] = []
    monkeypatch.setattr(Job, "train", lambda job: noted.extend(sys.argv))
    monkeypatch.setattr(sys, "argv", ["default_worker.py", "--gcs-address=10.0.0.7:38725"])
    (job,) = some_jobs(tmp_path, 1)
    assert carry_out(job, job.config.read_bytes())[0] == ""
    assert noted == ["arcade-torch", "train", *job.words] and len(sys.argv) == 2


def test_a_worker_that_was_started_deaf_to_interrupts_hears_that_its_run_is_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind ``&`` in a script SIGINT is ignored: a stopped study waited a minute, and what its
    runs had done since their last checkpoints was lost.
    """

    def train(job: Job) -> None:
        _thread.interrupt_main()  # as Ray's cancel does
        time.sleep(1)

    monkeypatch.setattr(Job, "train", train)
    (job,) = some_jobs(tmp_path, 1)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt):
            carry_out(job, job.config.read_bytes())
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_small_training")
def test_where_the_disk_is_shared_the_run_is_written_there(tmp_path: Path) -> None:
    assert run_all(FakeRay(carry_out), some_jobs(tmp_path, 1))["run0"].error == ""
    assert (tmp_path / "runs/run0/checkpoints/frames-1/trainer.pt").exists()
    assert not (tmp_path / "far").exists()


@pytest.mark.usefixtures("_small_training")
def test_where_the_disk_is_not_shared_the_small_files_travel_back(tmp_path: Path) -> None:
    def elsewhere(job: Job, config: bytes) -> Any:
        return carry_out(job._replace(config=tmp_path / "nowhere" / job.config.name), config)

    assert run_all(FakeRay(elsewhere), some_jobs(tmp_path, 1))["run0"].error == ""
    run = tmp_path / "runs" / "run0"
    found = sorted(path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file())
    assert found == ["checkpoints/frames-1/weights.safetensors", "eval.json"]
    assert "run0" in (run / "eval.json").read_text()
    assert not list((tmp_path / "far").glob("*/*"))


@pytest.mark.usefixtures("_small_training")
def test_a_failed_run_leaves_its_checkpoints_where_it_was_carried_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the trainer's state they came home as checkpoints that no attempt could go on
    from.
    """
    whole = Job.train

    def fails(job: Job) -> None:
        whole(job)
        (job.folder / "metrics.csv").write_text("frames\n")
        (job.folder / "eval.json").unlink()
        raise RuntimeError("a bad day")

    monkeypatch.setattr(Job, "train", fails)
    (job,) = some_jobs(tmp_path, 1)
    error, _, files = carry_out(
        job._replace(config=tmp_path / "nowhere.json"), job.config.read_bytes()
    )
    assert error == "RuntimeError: a bad day" and list(files) == ["metrics.csv"]
    assert len(list((tmp_path / "far").rglob("trainer.pt"))) == 1  # another attempt there goes on


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
    engine.module = SimpleNamespace(
        **{name: getattr(ray, name) for name in dir(ray)} | {"wait": spy}
    )
    results = study(what, tmp_path / "ray", engine, stream=io.StringIO())
    assert results.finished == 2 and not ray.is_initialized()
    assert study(what, tmp_path / "inline", "inline", stream=io.StringIO()).finished == 2
    assert (tmp_path / "ray/results.csv").read_bytes() == (
        tmp_path / "inline/results.csv"
    ).read_bytes()
    if Path("/proc/net/tcp").exists():
        assert len(listening) > 3 and all(is_loopback(address) for address in listening), set(
            listening
        )


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
