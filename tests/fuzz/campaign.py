"""The campaign: every case of `tests.fuzz.attacks` in a process of its own, within limits, and what
became of it.

    python -m tests.fuzz.campaign                     everything, about twenty minutes of one core
    python -m tests.fuzz.campaign --only file/fifo    the cases whose names begin so, such as one
                                                      that failed

Every case works in a fresh copy of a trained run, a study and their files. Beside it lies a folder
that nobody may touch. A case is fine if it worked, if it was refused in one line, or if it was
stopped with one.
"""

import argparse
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from arcade_torch.agents import preset, train
from arcade_torch.tools.files import markdown_table, write_between
from arcade_torch.tools.text import printable
from tests.fuzz.attacks import COMMANDS, Case, cases
from tests.tools.fabricated import small_study, write_study
from tests.tools.test_bench_registry import RESULTS

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 60.0
MEMORY_KB = 10 * 2**20
"""Of address space; torch and JAX alone reserve five gigabytes."""
FINE = ("worked", "refused", "stopped")
OUTCOMES = (*FINE, "traceback", "hang", "crash", "silent", "wordy", "outside")
BEGIN, END = "<!-- campaign -->", "<!-- end of campaign -->"
STUDY = """games = ["CartPoleEasy"]
memories = ["mlp"]
observability = ["full"]
seeds = 1
preset = "smoke"
total_frames = 128
"""


class Result(NamedTuple):
    """What became of a case."""

    case: Case
    outcome: str  # one of `OUTCOMES`
    code: int | None
    err: str
    seconds: float


def make_base(folder: Path) -> Path:
    """The files that every case starts from: ``work`` and ``outside``."""
    work = folder / "work"
    (folder / "outside" / "deep").mkdir(parents=True)
    (folder / "outside" / "victim.txt").write_text("precious")
    (folder / "outside" / "deep" / "window-000000001.safetensors").write_text("precious")
    for name, algorithm in (("run", "pqn"), ("replay", "dqn")):
        settings = {
            "env": "CartPoleEasy-v0",
            "algorithm": algorithm,
            "total_frames": 256,
            "checkpoint_every": 64,
        }
        train(preset("smoke", **settings), work / name)
        (work / name / "eval.json").unlink()  # so that there is something to go on with
        shutil.rmtree(work / name / "checkpoints" / "frames-000000000256")
        (work / name / "checkpoints" / "latest").write_text("frames-000000000192")
    write_study(work / "study", small_study())
    (work / "study.toml").write_text(STUDY)
    (work / "bench.json").write_text(json.dumps(RESULTS))
    return folder


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Mode and content of every file of a folder."""
    paths = sorted(folder.rglob("*"))
    return {
        str(path): (path.stat().st_mode, b"" if path.is_dir() else path.read_bytes())
        for path in paths
    }


def precious(work: Path) -> set[str]:
    """Files of the user in a working folder: those that hold this one word."""
    files = [path for path in work.rglob("*") if path.is_file() and not path.is_symlink()]
    return {
        str(path) for path in files if path.stat().st_size == 8 and path.read_bytes() == b"precious"
    }


def carry_out(case: Case, base: Path, usual_s: float) -> Result:
    """Run one case."""
    with tempfile.TemporaryDirectory(prefix="campaign-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        shutil.copytree(base, folder, dirs_exist_ok=True, symlinks=True)
        work = folder / "work"
        try:
            if case.prepare is not None:
                case.prepare(work)
        except OSError as error:  # such as a file system that takes no such name
            return Result(case, "worked", None, f"not tried: {error}", 0.0)
        before = snapshot(folder / "outside")
        theirs = precious(work)
        began = time.monotonic()
        code, out, err = run(case, work, usual_s)
        seconds = time.monotonic() - began
        outcome = judge(case, code, out, err)
        gone = case.name.startswith("folder/gone")
        if snapshot(folder / "outside") != before or (not gone and theirs - precious(work)):
            outcome = "outside"
        unmount(work)
        return Result(case, outcome, code, err, seconds)


def command_line(case: Case) -> list[str]:
    """The shell and the words that run a case."""
    words = case.words.split() if isinstance(case.words, str) else list(case.words)
    program = [sys.executable, *case.flags, "-m", "arcade_torch.tools", *words]
    start = "" if "|" in case.redirect else "exec "
    script = f'set -o pipefail; ulimit -v {MEMORY_KB}; {start}"$@" {case.redirect}'
    return ["bash", "-c", script, "bash", *program]


def run(case: Case, work: Path, usual_s: float) -> tuple[int | None, str, str]:
    """Exit code (None if it took too long), stdout and stderr."""
    ours = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    process = subprocess.Popen(
        command_line(case),
        cwd=work,
        env={**os.environ, **ours, **case.environment},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        if case.moment is not None and case.happens is not None:
            wait_for_handlers(process)
            time.sleep(case.moment * usual_s)
            case.happens(process, work)
        out, err = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        return None, out.decode("utf-8", "replace"), err.decode("utf-8", "replace")
    return process.returncode, out.decode("utf-8", "replace"), err.decode("utf-8", "replace")


def wait_for_handlers(process: "subprocess.Popen[bytes]") -> None:
    """Wait until a process catches SIGTERM: before, it is bash, or Python that is being started."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline and process.poll() is None:
        status = Path(f"/proc/{process.pid}/status").read_text()
        name = status.splitlines()[0].split()[1]
        caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
        if name != "bash" and int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.005)


def judge(case: Case, code: int | None, out: str, err: str) -> str:
    """The outcome of a case."""
    if code is None:
        return "hang"
    if (
        "Traceback (most recent" in err
        or "fault of arcade-torch" in err
        or "Exception ignored" in err
    ):
        return "traceback"
    if code < 0 or code > 130:
        return "crash"
    if code == 0:
        return "worked"
    said = [line for line in err.splitlines() if line.startswith("arcade-torch: ")]
    if code == 130:
        return "stopped" if len(said) == 1 and "stopped" in said[0] else "silent"
    if "2>&-" in case.redirect:
        return "refused"
    said += [line for line in out.splitlines() if line.startswith(("failed: ", "stopped: "))]
    return "refused" if len(said) == 1 else "wordy" if said else "silent"


def unmount(work: Path) -> None:
    """Take away the disks that a case has mounted."""
    mounted = [line.split()[1] for line in Path("/proc/mounts").read_text().splitlines()]
    for place in mounted:
        if place.startswith(f"{work}/"):
            subprocess.run(["umount", "--lazy", place], check=False)


def usual_times(base: Path, wanted: Iterable[Case]) -> dict[str, float]:
    """Seconds that each command takes when nothing happens; the second time, as the first one
    compiles.
    """
    times = {}
    needed = {case.words for case in wanted if case.moment is not None}
    for name, words in COMMANDS.items():
        if words not in needed:
            continue
        for _ in range(2):
            result = carry_out(Case(f"nothing/{name}", words), base, 0.0)
            if result.outcome != "worked":
                raise SystemExit(
                    f"{words} fails without any attack, exit code {result.code}:\n{result.err}"
                )
        times[words] = result.seconds
    return times


def table(results: Iterable[Result]) -> str:
    """Counts of outcomes by kind of case, as Markdown."""
    counts: dict[str, Counter[str]] = {}
    for result in results:
        kind = (
            "/".join(result.case.name.split("/")[:2])
            if not result.case.name.startswith("options")
            else "options"
        )
        counts.setdefault(kind, Counter())[result.outcome] += 1
    counts["all"] = sum(counts.values(), Counter())
    rows = [
        [kind, f"{sum(row.values())}", *(f"{row[name]}" for name in OUTCOMES)]
        for kind, row in counts.items()
    ]
    return markdown_table(["kind", "cases", *OUTCOMES], rows, left=1)


def main() -> int:
    """Run the campaign; exit code 1 if a case is not fine."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--moments", type=int, default=6, help="signals to each command")
    parser.add_argument("--only", default="", help="beginning of the names of cases")
    parser.add_argument("--every", type=int, default=1, help="of the cases only each such one")
    parser.add_argument(
        "--page", type=Path, help="Markdown file that gets the table between its marks"
    )
    options = parser.parse_args()
    if options.page is not None and BEGIN not in options.page.read_text():
        parser.error(f"{options.page} has no line {BEGIN}")
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # in the background of a shell it is ignored
    chosen = [
        case for case in cases(options.seed, options.moments) if case.name.startswith(options.only)
    ]
    chosen = chosen[:: options.every]
    results = []
    with tempfile.TemporaryDirectory(prefix="campaign-base-") as name:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(name) / "jax"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
        base = make_base(Path(name) / "base")
        usual = usual_times(base, chosen)
        for case in chosen:
            words = case.words if isinstance(case.words, str) else " ".join(case.words)
            result = carry_out(case, base, usual.get(words, 2.0))
            results.append(result)
            if result.outcome not in FINE:
                tell(result, options)
    text = table(results)
    print(text)
    if options.page is not None:
        when = (
            f"{time.strftime('%Y-%m-%d')}, seed {options.seed}, "
            f"{sum(one.seconds for one in results):.0f} s:"
        )
        write_between(options.page, BEGIN, END, f"{when}\n\n{text}")
    return int(any(result.outcome not in FINE for result in results))


def tell(result: Result, options: argparse.Namespace) -> None:
    """Print what went wrong, and how to see it again."""
    again = [
        "python",
        "-m",
        "tests.fuzz.campaign",
        "--seed",
        str(options.seed),
        "--moments",
        str(options.moments),
    ]
    print(
        f"{result.outcome}, exit code {result.code}, {result.seconds:.1f} s: "
        f"{printable(result.case.name)}"
    )
    print(f"  again: {printable(shlex.join([*again, '--only', result.case.name]))}")
    for line in result.err.splitlines()[-3:]:
        print(f"  | {printable(line)[:300]}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
