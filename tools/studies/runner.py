"""Run a study: skip what is finished, resume what was interrupted, keep what others did when one fails."""

import contextlib
import errno
import re
import shutil
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arcade_torch.agents.runs.files import write_json
from arcade_torch.tools.progress import Bars, Speed
from arcade_torch.tools.runs import Run
from arcade_torch.tools.studies.engines import Engine, Inline, Job, Processes, Ray, available_cores
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study

if TYPE_CHECKING:
    from arcade_torch.agents.config import TrainConfig

LEAST_FREE_BYTES = 1 << 20
"""A run that fails with less space than this on the disk failed for want of space."""


class DiskFullError(RuntimeError):
    """There is no space left; what is finished is kept, what is not goes on from its last checkpoint."""


@dataclass(frozen=True)
class StudyResult:
    """Where a study stands after an invocation."""

    root: Path
    rows: list[dict[str, Any]]
    """of ``results.csv``"""
    errors: dict[str, str]
    """run name -> one line, for runs that failed in this invocation"""

    @property
    def finished(self) -> int:
        """Number of finished runs."""
        return sum(row["status"] == "finished" for row in self.rows)


def study(
    what: Study | str | Path,
    out: str | Path,
    engine: Engine | str = "auto",
    workers: int = 0,
    command: str = "",
    stream: Any = None,
    shard: str = "",
) -> StudyResult:
    """Carry out a study, or go on with it.

    Finished runs are skipped, interrupted ones resumed from their last checkpoint, failed ones tried again.

    Args:
        what: a study or the path of its TOML file.
        out: folder of the study; made if it is missing, continued if it holds this study.
        engine: where the runs are carried out: ``auto``, ``inline``, ``processes``, ``ray`` or an object with a
            method ``run``.
        workers: how many runs at once, 0 for one a core.
        command: how the user started this, kept in ``study.json``.
        stream: where progress is shown, stderr by default.
        shard: ``3/10`` carries out the third tenth of the runs; others, in the same folder, the other tenths.

    Returns:
        The rows of ``results.csv`` and the errors of this invocation.

    Raises:
        FileNotFoundError: there is no such file.
        FileExistsError: ``out`` holds something else.
        ValueError: the study names a game, memory model or setting that does not exist, or is no study.
        DiskFullError: there is no space left for results; what is finished is kept.
    """
    what = what if isinstance(what, Study) else Study.load(what)
    engine = make_engine(engine, workers) if isinstance(engine, str) else engine
    plan, folder = planned(what, shard), StudyFolder(Path(out))
    try:
        folder.claim(what, command)
        folder.write_results(what)
        jobs = []
        for run in (run for run in plan if folder.run(run).final is None):
            file = write_json(folder.root / "configs" / f"{run.name}.json", plan[run].to_dict())
            jobs.append(Job(run.name, file, folder.run(run).path, folder.log(run)))
        errors = _carry_out(what, folder, {run.name: run for run in plan}, jobs, engine, stream) if jobs else {}
        return StudyResult(folder.root, folder.write_results(what), errors)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskFullError(f"{error.strerror}: {error.filename or 'the study'}; make room and start again") from error


def make_engine(name: str, workers: int = 0, **of_ray: Any) -> Engine:
    """An engine by its name; ``auto`` takes processes where there is more than one core. For Ray see :class:`Ray`."""
    if workers < 0:
        raise ValueError(f"workers must be at least 1 (or 0 for as many as there is room for), got {workers}")
    if name == "ray":
        return Ray(workers, **of_ray)
    if wrong := [key for key, value in of_ray.items() if value != getattr(Ray, key)]:
        raise ValueError(f"--{wrong[0].replace('_', '-')} is for --engine ray, and the engine is {name}")
    if name == "processes" or (name == "auto" and len(available_cores()) > 1):
        return Processes(workers)
    if name in ("auto", "inline"):
        return Inline()
    raise ValueError(f"unknown engine {name!r}: allowed are auto, inline, processes, ray")


def planned(what: Study, shard: str = "") -> "dict[RunSpec, TrainConfig]":
    """The runs of a study with their configs; of shard ``3/10`` every tenth run from the third.

    Raises:
        ValueError: a game, a memory model or a setting does not exist, or it is no shard.
    """
    from arcade_torch.envs_jax import make
    from arcade_torch.models import make_memory, memory_names

    for game in what.games:
        make(game)
    for memory in what.memories:
        if memory not in (*memory_names(), "feedforward"):
            make_memory(memory, 1, 1)  # refuses it
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", shard or "1/1")
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f"a shard is written 3/10, the third of ten; got {shard!r}")
    return {run: what.config(run) for run in what.runs()[int(found[1]) - 1 :: int(found[2])]}


def _carry_out(
    what: Study, folder: StudyFolder, runs: Mapping[str, RunSpec], jobs: list[Job], engine: Engine, stream: Any
) -> dict[str, str]:
    ended, errors = set(runs) - {job.name for job in jobs}, dict[str, str]()
    display = Display(what.name, {name: folder.run(run) for name, run in runs.items()}, ended, stream)
    with display, contextlib.closing(engine.run(jobs)) as results:  # type: ignore[type-var]
        if ended:
            display.note(f"{len(ended)} of {len(runs)} runs are finished already")
        for result in results:
            run, error = runs[result.name], ""
            ended.add(result.name)
            if folder.run(run).final is None:  # a process killed after its last word has done its work
                error = errors[result.name] = result.error or "ended without a final evaluation"
                display.note(f"{result.name} failed: {error} (log: {folder.log(run)})")
            folder.note_failure(run, error)
            folder.write_results(what)
            if error and ("No space left" in error or shutil.disk_usage(folder.root).free < LEAST_FREE_BYTES):
                raise DiskFullError(f"the disk with {folder.root} is full ({error}); make room and start it again")
    return errors


class Display:
    """Shows how far a study is, from the ``progress.json`` of its runs: a bar for all and one for each run at work.

    ``ended`` holds the names of the runs that have ended; the caller adds to it.
    """

    def __init__(self, title: str, runs: Mapping[str, Run], ended: set[str], stream: Any = None) -> None:
        self.title, self.runs, self.ended = title, runs, ended
        self.bars, self.speed = Bars(stream, first_line_s=3.0), Speed()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, daemon=True, name="study-progress")

    def __enter__(self) -> "Display":
        """Start to show."""
        self.bars.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Show the last state and stop."""
        self._stop.set()
        self._thread.join()
        line = self.show()
        self.bars.__exit__()
        if not self.bars.stream.isatty():
            self.note(line)

    def note(self, text: str) -> None:
        """Print a line."""
        self.bars.note(f"{self.title}: {text}")

    def show(self) -> str:
        """Read all folders once and draw the bars; returns what a log gets, in one line."""
        seen = {name: run.progress() for name, run in self.runs.items()}
        usual = next((wanted for _, wanted, _ in seen.values() if wanted), 0)
        frames, total, terminal = 0, 0, self.bars.stream.isatty()
        for name, (done, wanted, status) in seen.items():
            wanted = wanted or usual
            done = wanted if name in self.ended else min(done, wanted)
            frames, total = frames + done, total + wanted
            bar = f"  {name.replace('__', ' ')}"
            if terminal and status == "running" and name not in self.ended:
                self.bars.update(bar, done, wanted)
            else:
                self.bars.remove(bar)
        pace = self.speed.words(frames, total)
        share = 100 * frames / total if total else 0
        runs = f"{len(self.ended)}/{len(self.runs)} runs"
        line = f"{runs}, {frames:,} of {total:,} frames ({share:.0f} %){pace}"
        if terminal or frames < total:
            self.bars.update(self.title, frames, total or None, f"{runs}{pace}", f"{self.title}: {line}")
        return line

    def _loop(self) -> None:
        while not self._stop.wait(0.5):
            self.show()
