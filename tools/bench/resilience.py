"""Prove that studies survive: engines agree to the bit, kills lose nothing, nor does a full disk, nor company.

    python -m arcade_torch.tools.bench.resilience --work DIR [--rounds 20] [engines worker head kills disk together]

Every part runs a study of 24 short trainings for real and prints one line with what it found; exit code 1 if something
was lost, done twice or differs. Takes some minutes a part on two cores.
"""

import argparse
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
from importlib.util import find_spec
from pathlib import Path

from arcade_torch.tools.files import read_csv, read_json

STUDY = """
games = ["SignpostEasy", "MineSweeperEasy"]
memories = ["mingru", "gru", "mlp"]
seeds = {seeds}
preset = "smoke"
"""
TIMES = ("seconds", "fps")
PARTS = ("engines", "worker", "head", "kills", "disk", "together")
_CLOCK = re.compile(
    r"\d{4}-\d\d-\d\d \d\d:\d\d|, \d+ s</span>|[\d.]+ minutes over all runs|--engine \w+"
    r"| --(?:cpus-per-run|gpus-per-run|retries) \d+"  # what only Ray is told
)


class Bench:
    """A place to run the same study again and again.

    Args:
        work: folder; each study gets one of its own below.
        seeds: of the study: 12 runs each.
        seed: of the random moments.
    """

    def __init__(self, work: Path, seeds: int = 2, seed: int = 0) -> None:
        self.work, self.runs, self.chance = work.resolve(), 12 * seeds, random.Random(seed)
        self._text = STUDY.format(seeds=seeds)

    def root(self, name: str) -> Path:
        """The folder of a study; the command that makes it is the same for all."""
        place = self.work / name
        place.mkdir(parents=True, exist_ok=True)
        (place / "short.toml").write_text(self._text)
        return place / "out"

    def start(self, root: Path, engine: str = "processes") -> "subprocess.Popen[bytes]":
        """Start the study, or go on with it."""
        words = [sys.executable, "-m", "arcade_torch.tools", "study", "short.toml", "--out", "out", "--no-report"]
        with (root.parent / "printed.log").open("ab") as log:
            return subprocess.Popen(
                [*words, "--engine", engine], cwd=root.parent, stdout=log, stderr=log, start_new_session=True
            )

    def carry_out(self, root: Path, engine: str = "processes") -> int:
        """Run the study to its end; returns the exit code."""
        return self.start(root, engine).wait()

    def undisturbed(self) -> dict[str, str]:
        """Fingerprint of the study run without any trouble, made once."""
        root = self.root("inline")
        if len(finished(root)) < self.runs:
            self.carry_out(root, "inline")
        return fingerprint(root)


def finished(root: Path) -> dict[str, tuple[int, str]]:
    """Run name -> time and content of its final evaluation."""
    found = {}
    for file in root.glob("runs/*/eval.json"):
        found[file.parent.name] = (file.stat().st_mtime_ns, digest(file.read_bytes()))
    return found


def digest(data: bytes) -> str:
    """The first half of a SHA-256."""
    return hashlib.sha256(data).hexdigest()[:32]


def fingerprint(root: Path) -> dict[str, str]:
    """What a study found, without what a clock says: its table, and every run's curve, returns and weights."""
    found = {"results.csv": digest((root / "results.csv").read_bytes())}
    for run in sorted(path for path in (root / "runs").iterdir() if path.is_dir()):
        final = read_json(run / "eval.json")
        rows = [[row[key] for key in row if key not in TIMES] for row in read_csv(run / "metrics.csv")]
        weights = sorted(run.glob("checkpoints/frames-*/weights.safetensors"))[-1]
        parts = [final["returns"], final["lengths"], final["train_max_ewm"], rows, digest(weights.read_bytes())]
        found[run.name] = digest(repr(parts).encode())
    return found


def page(root: Path) -> str:
    """The study's report without what a clock says and without the name of the engine."""
    from arcade_torch.tools.reports.build import report

    before = Path.cwd()
    os.chdir(root.parent)
    try:
        return _CLOCK.sub("", report("out", saliency=False, references=False).read_text())
    finally:
        os.chdir(before)


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
    """Processes in which the Ray cluster of a study carries out runs, or waits for one; Ray's own agents left out."""
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


def engines(bench: Bench) -> tuple[str, bool]:
    """The same study on every engine: the same table and runs to the bit."""
    names = ["inline", "processes", *(["ray"] if find_spec("ray") else [])]
    prints, parts = [], []
    for name in names:
        root, began = bench.root(name), time.monotonic()
        code = bench.carry_out(root, name)
        prints.append(fingerprint(root))
        parts.append(f"{name} exit {code}, {len(finished(root))} runs, {time.monotonic() - began:.0f} s")
    same = all(each == prints[0] for each in prints)
    return f"{'; '.join(parts)}; results.csv {prints[0]['results.csv'][:12]}, same to the bit: {same}", same


def worker(bench: Bench) -> tuple[str, bool]:
    """Kill one worker in the middle, start again: the same as undisturbed, report included."""
    expected, root = bench.undisturbed(), bench.root("worker")
    study = bench.start(root)
    while study.poll() is None and (len(finished(root)) < bench.runs // 3 or not children(study.pid)):
        time.sleep(0.05)
    time.sleep(bench.chance.uniform(0, 6))
    kill(*children(study.pid)[:1])
    code = study.wait()
    before = finished(root)
    failed = [row["run"] for row in read_csv(root / "results.csv") if row["status"] == "failed"]
    again = bench.carry_out(root)
    kept = all(finished(root)[name] == seen for name, seen in before.items())
    same = fingerprint(root) == expected
    pages = page(root) == page(bench.root("inline"))
    told = f"exit {code} with {len(before)} runs finished and {len(failed)} failed; again: exit {again}, finished runs "
    told += f"untouched: {kept}, same to the bit: {same}, same report: {pages}"
    return told, kept and same and pages and len(failed) == (code == 1)


def head(bench: Bench) -> tuple[str, bool]:
    """On Ray: kill a worker, later the study with its whole cluster, start again: the same as undisturbed."""
    expected, root = bench.undisturbed(), bench.root("head")
    study = bench.start(root, "ray")
    while study.poll() is None and (len(finished(root)) < bench.runs // 4 or not ray_workers(study.pid)):
        time.sleep(0.05)
    workers = ray_workers(study.pid)
    kill(*workers[:1])
    while study.poll() is None and len(finished(root)) < bench.runs // 2:
        time.sleep(0.05)
    running = study.poll() is None
    kill(study.pid, *descendants(study.pid))
    study.wait()
    before = finished(root)
    again = bench.carry_out(root, "ray")
    kept = all(finished(root)[name] == seen for name, seen in before.items())
    same, pages = fingerprint(root) == expected, page(root) == page(bench.root("inline"))
    told = f"one of {len(workers)} workers killed, then the study and its cluster with {len(before)} runs finished; "
    told += f"again: exit {again}, finished runs untouched: {kept}, same to the bit: {same}, same report: {pages}"
    return told, bool(workers) and running and again == 0 and kept and same and pages


def kills(bench: Bench, rounds: int = 20) -> tuple[str, bool]:
    """SIGKILL at random moments to the study, to a worker, or to all of them, then to the end."""
    expected, root = bench.undisturbed(), bench.root("kills")
    seen: dict[str, tuple[int, str]] = {}
    victims, kept, ended = {"study": 0, "worker": 0, "all": 0}, True, 0
    for _ in range(rounds):
        study = bench.start(root, bench.chance.choice(["inline", "processes"]))
        wait_s = bench.chance.uniform(2, 30)
        deadline = time.monotonic() + wait_s
        while study.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        ended += study.poll() is not None
        victim = bench.chance.choice(list(victims))
        victims[victim] += 1
        workers = children(study.pid)
        kill(*{"study": [study.pid], "worker": workers[:1], "all": [study.pid, *workers]}[victim])
        if victim == "worker":  # the study goes on for a moment, then it is killed as well
            time.sleep(1)
            kill(study.pid)
        study.wait()
        now = finished(root)
        kept = kept and all(now.get(name) == value for name, value in seen.items())
        seen |= now
    code = bench.carry_out(root)
    kept = kept and all(finished(root).get(name) == value for name, value in seen.items())
    same = fingerprint(root) == expected
    rest = [str(path) for path in root.rglob("*") if re.fullmatch(r"\..*\.\d+", path.name) or "owner-" in path.name]
    told = f"{rounds} kills ({', '.join(f'{n} {name}' for name, n in victims.items())}; {ended} came after the end), "
    told += (
        f"{len(seen)} runs finished on the way; at the end exit {code}, finished runs untouched: {kept}, same to the"
    )
    return f"{told} bit: {same}, litter: {len(rest)} files", kept and same


@contextlib.contextmanager
def small_disk(place: Path, kib: int) -> Iterator[Callable[[int], None]]:
    """A file system in memory of that size at a place; yields a function that gives it another.

    Raises:
        PermissionError: this user may not mount.
    """
    place.mkdir(parents=True, exist_ok=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(place)], check=False, capture_output=True, text=True
    )
    if mounted.returncode:
        raise PermissionError(f"cannot mount a small disk: {mounted.stderr.strip()}")

    def resize(size: int) -> None:
        subprocess.run(["mount", "-o", f"remount,size={size}k", str(place)], check=True)

    try:
        yield resize
    finally:
        subprocess.run(["umount", "-l", str(place)], check=False)


def disk(bench: Bench) -> tuple[str, bool]:
    """A disk too small for the study, then one with room: finished runs intact, the others resumed to the bit."""
    expected = bench.undisturbed()
    kib = sum(file.stat().st_size for file in bench.root("inline").rglob("*") if file.is_file()) // 1024
    place, told, fine, before = bench.work / "small", [], True, dict[str, tuple[int, str]]()
    with small_disk(place, kib // 4) as resize:
        root = bench.root("small")
        for share in (4, 2):
            resize(kib // share)
            code = bench.carry_out(root, "inline")
            now = finished(root)
            fine = fine and code == 1 and all(now[name] == value for name, value in before.items())
            before = now
            told.append(f"{kib // share} KiB: exit {code}, {len(now)} finished")
        resize(kib * 4)
        code = bench.carry_out(root, "inline")
        kept = all(finished(root)[name] == value for name, value in before.items())
        same = fingerprint(root) == expected
        shutil.copy(place / "printed.log", bench.work / "small.log")
    last = f"with room: exit {code}, finished runs untouched: {kept}, same to the bit: {same}"
    return "; ".join([*told, last]), fine and kept and same


def together(bench: Bench, processes: int = 3) -> tuple[str, bool]:
    """Several studies in one folder at once, one of them killed: every run is done, none twice."""
    expected, root = bench.undisturbed(), bench.root("together")
    studies = [bench.start(root, "inline") for _ in range(processes)]
    while len(finished(root)) < bench.runs // 3 and any(study.poll() is None for study in studies):
        time.sleep(0.05)
    kill(studies[0].pid)
    codes = [study.wait() for study in studies]
    text = (root.parent / "printed.log").read_text() + "".join(file.read_text() for file in root.glob("logs/*.log"))
    ends = [text.count(f"finished: {name}") for name in [f"out/runs/{run}\n" for run in finished(root)]]
    same = fingerprint(root) == expected
    told = f"{processes} studies at once, exit {codes}; {len(ends)} of {bench.runs} runs finished, "
    return f"{told}{sum(ends)} trainings ended, most for one run {max(ends)}; same to the bit: {same}", (
        same and max(ends) == 1 and codes[1:] == [0] * (processes - 1)
    )


def main() -> int:
    """Run the parts that are named, or all.

    Returns:
        1 if a part found something wrong.
    """
    parser = argparse.ArgumentParser(prog="python -m arcade_torch.tools.bench.resilience", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--work", type=Path, required=True, help="folder for the studies, new or of an earlier run")
    parser.add_argument("--rounds", type=int, default=20, help="kills")
    parser.add_argument("--seeds", type=int, default=2, help="12 runs each")
    options = parser.parse_args()
    bench, fine = Bench(options.work, options.seeds), True
    known: dict[str, Callable[[], tuple[str, bool]]] = {
        "engines": lambda: engines(bench),
        "worker": lambda: worker(bench),
        "head": lambda: head(bench),
        "kills": lambda: kills(bench, options.rounds),
        "disk": lambda: disk(bench),
        "together": lambda: together(bench),
    }
    for name in options.parts or PARTS:
        if name not in known:
            parser.error(f"unknown part {name!r}: parts are {', '.join(PARTS)}")
        began = time.monotonic()
        told, good = known[name]()
        fine = fine and good
        print(f"{name}: {'ok' if good else 'WRONG'} ({time.monotonic() - began:.0f} s): {told}", flush=True)
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
