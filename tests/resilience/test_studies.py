"""Studies survive: engines agree to the bit, kills lose nothing, nor does a full disk, nor company.

Every test runs a study of 24 short trainings for real, some minutes each on two cores::

    make test-slow ARGS=tests/resilience
"""

import contextlib
import hashlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from arcade_torch.agents.runs.files import read_csv, read_json

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3000)]
RUNS = 24
STUDY = """
games = ["SignpostEasy", "MineSweeperEasy"]
memories = ["mingru", "gru", "mlp"]
seeds = 2
preset = "smoke"
"""
KILLS = int(os.environ.get("RESILIENCE_KILLS", "8"))
"""Rounds of kills at random moments."""


class Place:
    """A folder in which the same study is run again and again.

    Args:
        work: the folder; each study gets one of its own below.
    """

    def __init__(self, work: Path) -> None:
        self.work = work.resolve()

    def root(self, name: str) -> Path:
        """The folder of a study."""
        place = self.work / name
        place.mkdir(parents=True, exist_ok=True)
        (place / "short.toml").write_text(STUDY)
        return place / "out"

    def start(
        self, root: Path, engine: str = "processes", *options: str
    ) -> "subprocess.Popen[bytes]":
        """Start the study, or go on with it."""
        words = [
            sys.executable,
            "-m",
            "arcade_torch.tools",
            "study",
            "short.toml",
            "--out",
            "out",
            "--no-report",
        ]
        with (root.parent / "printed.log").open("ab") as log:
            return subprocess.Popen(
                [*words, "--engine", engine, *options],
                cwd=root.parent,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def carry_out(self, root: Path, engine: str = "processes", *options: str) -> int:
        """Run the study to its end; returns the exit code."""
        return self.start(root, engine, *options).wait()

    def undisturbed(self) -> dict[str, str]:
        """Fingerprint of the study run without any trouble, made once."""
        root = self.root("inline")
        if len(finished(root)) < RUNS:
            assert self.carry_out(root, "inline") == 0
        return fingerprint(root)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    return Place(tmp_path_factory.mktemp("resilience"))


def finished(root: Path) -> dict[str, tuple[int, str]]:
    """Run name -> time and content of its final evaluation."""
    files = root.glob("runs/*/eval.json")
    return {
        file.parent.name: (file.stat().st_mtime_ns, digest(file.read_bytes())) for file in files
    }


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


def fingerprint(root: Path) -> dict[str, str]:
    """What a study found, without what a clock says: its table, and every run's curve, returns and
    weights.
    """
    found = {"results.csv": digest((root / "results.csv").read_bytes())}
    for run in sorted(path for path in (root / "runs").iterdir() if path.is_dir()):
        final = read_json(run / "eval.json")
        rows = [
            [row[key] for key in row if key not in ("seconds", "fps")]
            for row in read_csv(run / "metrics.csv")
        ]
        weights = sorted(run.glob("checkpoints/frames-*/weights.safetensors"))[-1]
        parts = [
            final["returns"],
            final["lengths"],
            final["train_max_ewm"],
            rows,
            digest(weights.read_bytes()),
        ]
        found[run.name] = digest(repr(parts).encode())
    return found


def children(pid: int) -> list[int]:
    """Worker processes of a study."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = entry.read_text().rpartition(")")[2].split()
            if fields[1] == str(pid) and fields[0] not in "ZX":
                found.append(int(entry.parent.name))
    return found


def descendants(pid: int) -> list[int]:
    """Children of a process, theirs, and so on."""
    return [one for child in children(pid) for one in (child, *descendants(child))]


def ray_workers(pid: int) -> list[int]:
    """Processes in which the Ray cluster of a study carries out runs, or waits for one; Ray's own
    agents left out.
    """
    found = []
    for each in descendants(pid):
        with contextlib.suppress(OSError):
            name = Path(f"/proc/{each}/cmdline").read_bytes()
            if name.startswith(b"ray::") and b"Agent" not in name:
                found.append(each)
    return found


def kill(*pids: int) -> None:
    """SIGKILL."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def wait_for(study: "subprocess.Popen[bytes]", ready: Callable[[], bool]) -> None:
    """Wait until something holds, or the study has ended."""
    while study.poll() is None and not ready():
        time.sleep(0.05)


@pytest.mark.parametrize("engine", ["processes", pytest.param("ray", marks=pytest.mark.ray)])
def test_every_engine_gives_the_same_to_the_bit(place: Place, engine: str) -> None:
    if engine == "ray":
        pytest.importorskip("ray")
    root = place.root(engine)
    assert place.carry_out(root, engine) == 0
    assert fingerprint(root) == place.undisturbed()


def test_a_killed_worker_costs_nothing(place: Place) -> None:
    expected, root = place.undisturbed(), place.root("worker")
    study = place.start(root)
    wait_for(study, lambda: len(finished(root)) >= RUNS // 3 and bool(children(study.pid)))
    time.sleep(random.Random(0).uniform(0, 6))
    kill(*children(study.pid)[:1])
    code = study.wait()
    before = finished(root)
    failed = [row for row in read_csv(root / "results.csv") if row["status"] == "failed"]
    assert len(failed) == (code == 1) and all("ended by signal 9" in row["error"] for row in failed)
    assert place.carry_out(root) == 0
    assert {name: finished(root)[name] for name in before} == before
    assert fingerprint(root) == expected


@pytest.mark.ray
def test_a_killed_ray_worker_is_tried_again_and_a_killed_cluster_costs_nothing(
    place: Place,
) -> None:
    pytest.importorskip("ray")
    expected, root = place.undisturbed(), place.root("head")
    study = place.start(root, "ray")
    wait_for(study, lambda: len(finished(root)) >= RUNS // 4 and bool(ray_workers(study.pid)))
    kill(*ray_workers(study.pid)[:1])
    wait_for(study, lambda: len(finished(root)) >= RUNS // 2)
    assert study.poll() is None and not list(root.glob("failures/*"))
    kill(study.pid, *descendants(study.pid))
    study.wait()
    before = finished(root)
    assert place.carry_out(root, "ray") == 0
    assert {name: finished(root)[name] for name in before} == before
    assert fingerprint(root) == expected


def test_kills_at_random_moments_cost_nothing(place: Place) -> None:
    expected, root, chance = place.undisturbed(), place.root("kills"), random.Random(0)
    seen: dict[str, tuple[int, str]] = {}
    for _ in range(KILLS):
        study = place.start(root, chance.choice(["inline", "processes"]))
        end = time.monotonic() + chance.uniform(2, 30)
        wait_for(study, lambda end=end: time.monotonic() > end)  # type: ignore[misc]
        workers = children(study.pid)
        victim = chance.choice(["study", "worker", "all"])
        kill(*{"study": [study.pid], "worker": workers[:1], "all": [study.pid, *workers]}[victim])
        if victim == "worker":  # the study goes on for a moment, then it is killed as well
            time.sleep(1)
            kill(study.pid)
        study.wait()
        now = finished(root)
        assert {name: now.get(name) for name in seen} == seen
        seen = now
    assert place.carry_out(root) == 0
    assert {name: finished(root)[name] for name in seen} == seen
    assert fingerprint(root) == expected
    litter = [
        path
        for path in (root / "runs").rglob(".*")
        if re.fullmatch(r"\..*\.\d+-[0-9a-f]{8}", path.name)
    ]
    assert not litter


@contextlib.contextmanager
def small_disk(at: Path, kib: int) -> Iterator[Callable[[int], None]]:
    """A file system in memory of that size; yields a function that gives it another."""
    at.mkdir(parents=True, exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(at)]
    if subprocess.run(words, check=False, capture_output=True).returncode:
        pytest.skip("this user may not mount a small disk")
    try:
        yield (
            lambda size: (
                subprocess.run(["mount", "-o", f"remount,size={size}k", str(at)], check=True)
                and None
            )
        )
    finally:
        subprocess.run(["umount", "-l", str(at)], check=False)


def test_a_full_disk_costs_nothing(place: Place) -> None:
    expected = place.undisturbed()
    kib = (
        sum(file.stat().st_size for file in place.root("inline").rglob("*") if file.is_file())
        // 1024
    )
    before = dict[str, tuple[int, str]]()
    with small_disk(place.work / "small", kib // 4) as resize:
        root = place.root("small")
        for share in (4, 2):
            resize(kib // share)
            assert place.carry_out(root, "inline") == 1
            now = finished(root)
            assert {name: now[name] for name in before} == before and len(now) > len(before)
            before = now
        assert "finished runs are kept" in (root.parent / "printed.log").read_text()
        resize(kib * 4)
        assert place.carry_out(root, "inline") == 0
        assert {name: finished(root)[name] for name in before} == before
        assert fingerprint(root) == expected


def test_shards_in_one_folder_do_every_run_once_and_one_that_is_killed_goes_on(
    place: Place,
) -> None:
    expected, root = place.undisturbed(), place.root("shards")
    shards = [place.start(root, "inline", "--shard", f"{number}/3") for number in (1, 2, 3)]
    wait_for(shards[0], lambda: len(finished(root)) >= RUNS // 3)
    kill(shards[0].pid)
    assert [shard.wait() for shard in shards][1:] == [0, 0]
    before = finished(root)
    assert 2 * RUNS // 3 <= len(before) < RUNS
    assert place.carry_out(root, "inline", "--shard", "1/3") == 0
    assert {name: finished(root)[name] for name in before} == before
    assert fingerprint(root) == expected


def test_a_fingerprint_sees_a_single_bit_of_the_weights_and_no_clock(
    place: Place, tmp_path: Path
) -> None:
    before = place.undisturbed()
    root = Path(shutil.copytree(place.root("inline"), tmp_path / "out"))
    for file in root.glob("runs/*/metrics.csv"):
        rows = [line.split(",") for line in file.read_text().splitlines()]
        at = rows[0].index("seconds")
        slower = [rows[0], *([*row[:at], row[at] + "0", *row[at + 1 :]] for row in rows[1:])]
        file.write_text("".join(",".join(row) + "\n" for row in slower))
    assert fingerprint(root) == before
    weights = sorted(root.glob("runs/*/checkpoints/frames-*/weights.safetensors"))[-1]
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    changed = {name for name, value in fingerprint(root).items() if value != before[name]}
    assert changed == {weights.parents[2].name}
