"""Everything that needs a GPU, in stages: tests marked gpu, benchmarks, trainings; CSV files, and a
page made of them.

::

    python -m tests.gpu.stages FOLDER                 all stages on the GPU, as many as eight
                                                      minutes hold; again: what is not finished
    python -m tests.gpu.stages FOLDER --device cpu    a rehearsal: every stage on the CPU, in a
                                                      tiny form

A stage is a process; its output is FOLDER/NAME.log. FOLDER/NAME.done says that it never runs again.
What failed does not stop the others, and is tried again by the next call, after them. Where the
time ran out, a study goes on; any other stage begins anew. Tests of which none passed have failed.
Exit code: 0 all is done, 1 something failed, 2 there is more to do.

Nothing begins where a package is missing, or where torch or JAX sees no card: one line says so.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tests.gpu.needs import ROOT, stop_without_packages, why_no_card

if __name__ == "__main__":
    stop_without_packages()  # before the imports below fail, one after the other

from arcade_torch.agents.runs.files import read_csv, write_atomic
from arcade_torch.envs_jax import registered_ids
from arcade_torch.tools.bench.registry import TABLES
from arcade_torch.tools.files import write_csv

TESTS = {
    "bridge": ("tests/arcade_torch", "tests/gpu/test_bridge.py"),
    "models": ("tests/models", "tests/gpu/test_memories.py"),
    "agents": ("tests/agents", "tests/gpu/test_runs.py"),
}
"""Where tests marked gpu stand."""
FORMS = ("eager", "amp", "graphs", "compiled", "compiled+amp+graphs")
TEST_COLUMNS = ("test", "outcome", "seconds", "message")
STUDY_COLUMNS = ("run", "status", "frames", "seconds", "eval_mean", "train_max_ewm")
MACHINE = """
import sys
from pathlib import Path
from arcade_torch.tools.machine import machine
from arcade_torch.tools.files import write_csv
row = machine()
write_csv(Path(sys.argv[1]), [row], list(row))
"""
NOTHING_PASSED = 5
"""The exit code of tests that were all skipped: that of pytest where it has none to run."""
_GRACE_S, _LEAST_S, _TAIL = 30.0, 45.0, 15


@dataclass(frozen=True)
class Stage:
    """One process: words after ``python``, and whether it goes on where it was stopped."""

    name: str
    argv: tuple[str, ...]
    resumes: bool = False

    @property
    def is_tests(self) -> bool:
        """Whether pytest runs, and reports."""
        return any(word.startswith("--junitxml=") for word in self.argv)


def stages(folder: Path, device: str) -> list[Stage]:
    """All stages, the most telling ones first; on the CPU tiny ones."""
    tiny = device == "cpu"
    games = [id.removesuffix("-v0") for id in registered_ids() if "Easy" in id]
    found = [Stage("machine", ("-c", MACHINE, str(folder / "machine.csv")))]
    for name, paths in TESTS.items():
        words = (
            "-m",
            "pytest",
            "-q",
            "-m",
            "gpu",
            "-p",
            "no:cacheprovider",
            "--device",
            device,
            *paths,
        )
        found.append(Stage(f"tests-{name}", (*words, f"--junitxml={folder / f'tests-{name}.xml'}")))

    def bench(name: str, *words: str) -> None:
        command = ("-m", "arcade_torch.tools", "bench", name.split("-")[0], *words)
        found.append(Stage(name, (*command, "--out", str(folder / f"{name}.csv"))))

    sizes = ("2",) if tiny else ("128", "512", "2048", "8192", "16384")
    turns = (
        ("--seconds", "0.01", "--repeats", "1") if tiny else ("--seconds", "0.3", "--repeats", "3")
    )
    games.sort(key=("MineSweeperEasy", "CartPoleEasy").__contains__, reverse=True)
    for game in games[:1] if tiny else games[:2]:
        bench(f"envs-{game}", "--games", game, "--batches", *sizes, *turns)
    short = ("--memories", "mlp", "--grad-steps", "1", "--repeats", "1") if tiny else ()
    for network in ("small",) if tiny else ("small", "paper"):
        for form in FORMS[:1] if tiny else FORMS:
            bench(
                f"train-{network}-{form}",
                "--networks",
                network,
                "--forms",
                form,
                "--device",
                device,
                *short,
            )
    memory = (
        "gru",
        "--steps",
        "8",
        "--layers",
        "1",
        "--size",
        "8",
        "--batch",
        "2",
        "--frames",
        "4",
        *turns,
    )
    bench("memory", *(memory if tiny else ("--layers", "1")), "--device", device)
    for game in () if tiny else games[2:]:
        bench(f"envs-{game}", "--games", game, "--batches", *sizes, *turns)
    for name, plan in studies(games, device).items():
        toml = write_atomic(
            folder / f"study-{name}.toml",
            "".join(f"{key} = {value}\n" for key, value in plan.items()),
        )
        words = (
            "-m",
            "arcade_torch.tools",
            "study",
            str(toml),
            "--out",
            str(folder / f"study-{name}"),
            "--no-report",
        )
        words += ("--engine", "inline") if tiny else ("--engine", "processes", "--workers", "4")
        found.append(Stage(f"study-{name}", words, resumes=True))
    return found


def studies(games: Sequence[str], device: str) -> dict[str, dict[str, str]]:
    """Trainings as TOML: the Easy games and their twins with the small preset, and the paper's
    CartPoleEasy.
    """
    common = {"memories": '["lru"]', "seeds": "1", "settings": f'{{ device = "{device}" }}'}
    if device == "cpu":
        return {
            "tiny": {
                "games": '["CartPoleEasy"]',
                "preset": '"smoke"',
                "total_frames": "128",
                **common,
            }
        }
    listed = ", ".join(f'"{game}"' for game in games)
    paper = {"games": '["CartPoleEasy"]', "preset": '"paper"', **common}
    small = {"games": f"[{listed}]", "preset": '"small"', "algorithms": '["ppo"]', **common}
    return {"small": small, "paper": paper}


# -- running ---------------------------------------------------------------------------------------


def run(chosen: Sequence[Stage], folder: Path, seconds: float) -> dict[str, str]:
    """Run what is not finished until the time is over; returns name -> done, failed, unfinished or
    waiting.
    """
    end, first = time.monotonic() + seconds, True
    state = {stage.name: "done" if is_done(stage, folder) else "waiting" for stage in chosen}
    todo = [stage for stage in chosen if state[stage.name] == "waiting"]
    for stage in sorted(todo, key=lambda stage: (folder / f"{stage.name}.failed").exists()):
        left = end - time.monotonic()
        if left < min(_LEAST_S, seconds / 4) and not first:
            break
        print(f"{stage.name} ...", flush=True)
        began = time.monotonic()
        code = launch(stage, folder / f"{stage.name}.log", left)
        collect(stage, folder)
        if code == 0 and stage.is_tests and not any_passed(stage, folder):
            code = NOTHING_PASSED
        took = time.monotonic() - began
        goes_on = code is None and (
            stage.resumes or not first
        )  # no more may be missing than the time others took
        found, first = "unfinished" if goes_on else "failed" if code != 0 else "done", False
        state[stage.name] = found
        (folder / f"{stage.name}.failed").unlink(missing_ok=True)
        if not goes_on:
            write_atomic(folder / f"{stage.name}.{found}", f"exit code {code}, {took:.0f} s\n")
        why = ", no test passed" if code == NOTHING_PASSED else ""
        print(f"{stage.name}: {found}{why}, {took:.0f} s", flush=True)
        if found == "failed":
            print(*tail(folder / f"{stage.name}.log"), sep="\n", flush=True)
    return state


def is_done(stage: Stage, folder: Path) -> bool:
    """Whether a mark says that a stage never runs again; tests are asked whether any passed."""
    marked = (folder / f"{stage.name}.done").exists()
    return marked and (not stage.is_tests or any_passed(stage, folder))


def any_passed(stage: Stage, folder: Path) -> bool:
    """Whether a test of a stage passed, by its CSV file."""
    path = folder / f"{stage.name}.csv"
    return path.exists() and any(row["outcome"] == "passed" for row in read_csv(path))


def forget_marks_without_a_card(folder: Path) -> None:
    """Delete the marks of a folder whose machine had no card, with what it says of the machine: its
    stages measured a CPU.
    """
    path = folder / "machine.csv"
    if not path.exists():
        return
    row = read_csv(path)[0]
    if row["torch_device"] == "cuda" and row["jax_device"].startswith(("gpu", "cuda")):
        return
    marks = sorted(folder.glob("*.done"))
    for mark in [*marks, path]:
        mark.unlink()
    print(
        f"{len(marks)} stages were marked as done on a machine without a card "
        f"(torch on {row['torch_device']}, JAX on {row['jax_device']}): they run again",
        flush=True,
    )


def launch(stage: Stage, log: Path, seconds: float) -> int | None:
    """Run one stage with its output in a file; returns its exit code, None if the time ran out."""
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(
        filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))
    )
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(log.parent.resolve() / "cache"))
    environment["PYTHONUNBUFFERED"] = (
        "1"  # the log has every word in its place, also of a killed one
    )
    command = [sys.executable, *stage.argv]
    with log.open("w") as file:
        process = subprocess.Popen(
            command,
            stdout=file,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env=environment,
            start_new_session=True,
        )
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGTERM)  # a study saves its runs
            with suppress(subprocess.TimeoutExpired):
                process.wait(_GRACE_S)
            return None
        finally:
            with suppress(ProcessLookupError):  # and whatever it has started
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def tail(log: Path) -> list[str]:
    """The last lines of a log."""
    return log.read_text(errors="replace").splitlines()[-_TAIL:]


def collect(stage: Stage, folder: Path) -> None:
    """Turn what a stage left into FOLDER/NAME.csv, where it did not write that itself."""
    report, study = folder / f"{stage.name}.xml", folder / stage.name
    if report.exists():
        write_csv(folder / f"{stage.name}.csv", outcomes(report), TEST_COLUMNS)
        report.unlink()
    if (study / "results.csv").exists():
        seconds = {row["run"]: row["seconds"] for row in read_csv(study / "timings.csv")}
        rows = [
            row | {"seconds": seconds.get(row["run"])} for row in read_csv(study / "results.csv")
        ]
        write_csv(folder / f"{stage.name}.csv", rows, list(rows[0]))


def outcomes(report: Path) -> list[dict[str, Any]]:
    """Rows of what pytest wrote as JUnit XML."""
    rows = []
    for case in ElementTree.parse(report).iter("testcase"):
        said = next((child for child in case if child.tag in ("failure", "error", "skipped")), None)
        outcome, message = ("passed", "") if said is None else (said.tag, said.get("message", ""))
        name = f"{case.get('classname')}::{case.get('name')}"
        cells = (name, outcome, case.get("time"), " ".join(message.split())[:300])
        rows.append(dict(zip(TEST_COLUMNS, cells, strict=True)))
    return rows


# -- the page --------------------------------------------------------------------------------------


def page(folder: Path, state: Mapping[str, str], command: str) -> str:
    """What the CSV files of a folder say, as Markdown."""
    machine = read_csv(folder / "machine.csv")[0] if (folder / "machine.csv").exists() else {}
    made = ", ".join(f"{name} {value}" for name, value in machine.items() if value)
    lines = [
        "# On a GPU",
        "",
        f"`{command}`. {made or 'The machine is not known yet'}.",
        "",
        "## Stages",
        "",
    ]
    failed = {
        name: tail(folder / f"{name}.log")[-1:]
        for name, found in state.items()
        if found == "failed"
    }
    rows = [
        {"stage": name, "state": found, "said": "".join(failed.get(name, []))}
        for name, found in state.items()
    ]
    lines += table(rows, ("stage", "state", "said"))
    tests = {path.stem: read_csv(path) for path in sorted(folder.glob("tests-*.csv"))}
    counts = [
        {"stage": name} | Counter(row["outcome"] for row in found) for name, found in tests.items()
    ]
    lines += ["## Tests", "", *table(counts, ("stage", "passed", "failure", "error", "skipped"))]
    lines += table(
        [row for found in tests.values() for row in found if row["outcome"] != "passed"],
        TEST_COLUMNS,
    )
    for name, kind in TABLES.items():
        paths = sorted([*folder.glob(f"{name}-*.csv"), *folder.glob(f"memory_{name}.csv")])
        found = table([row for path in paths for row in read_csv(path)], (*kind.key, *kind.numbers))
        lines += [f"## {kind.title}", "", *found] if found else []
    for path in sorted(folder.glob("study-*.csv")):
        lines += [
            f"## Trainings: {path.stem.removeprefix('study-')}",
            "",
            *table(read_csv(path), STUDY_COLUMNS),
        ]
    return "\n".join(lines)


def table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> list[str]:
    """A Markdown table and an empty line; nothing without rows."""
    if not rows:
        return []
    cells = [[str(row.get(name) or "").replace("|", "\\|") for name in columns] for row in rows]
    return [
        *("| " + " | ".join(line) + " |" for line in (columns, ["---"] * len(columns), *cells)),
        "",
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Run stages, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", type=Path, help="where CSV files, logs and marks go; kept between calls"
    )
    parser.add_argument(
        "--device", choices=("cuda", "cpu"), default="cuda", help="cpu: a tiny rehearsal"
    )
    parser.add_argument("--minutes", type=float, default=8.0, help="of one call")
    parser.add_argument(
        "--only", nargs="+", default=["*"], help="names of stages, with * for any letters"
    )
    parser.add_argument("--page", type=Path, help="Markdown page; FOLDER/gpu.md by default")
    options = parser.parse_args(argv)
    if options.device == "cuda":
        problem = why_no_card()
        if problem:
            sys.exit(f"no stage was begun: {problem} (a rehearsal without a card: DEVICE=cpu)")
    folder: Path = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if options.device == "cuda":
        forget_marks_without_a_card(folder)
    found = stages(folder, options.device)
    chosen = [
        stage for stage in found if any(fnmatch(stage.name, pattern) for pattern in options.only)
    ]
    if not chosen:
        parser.error(
            f"no stage is called {' or '.join(options.only)}; there are "
            f"{', '.join(s.name for s in found)}"
        )
    state = run(chosen, folder, 60 * options.minutes)
    command = f"make gpu DEVICE={options.device}"
    print(write_atomic(options.page or folder / "gpu.md", page(folder, state, command)))
    left = Counter(state.values())
    print(", ".join(f"{count} {name}" for name, count in left.items()))
    return 1 if left["failed"] else 0 if left["done"] == len(state) else 2


if __name__ == "__main__":
    sys.exit(main())
