"""Run a study: skip what is finished, resume what was interrupted, keep what others did when one fails."""

import contextlib
import errno
import re
import shutil
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arcade_torch.tools.files import write_json
from arcade_torch.tools.progress import Bars, Speed, clock
from arcade_torch.tools.studies.engines import Engine, Inline, Job, Processes, available_cores
from arcade_torch.tools.studies.folder import RunFolder, StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study
from arcade_torch.tools.studies.ray_engine import Ray

ENGINES = ("auto", "inline", "processes", "ray")
LEAST_FREE_BYTES = 1 << 20
"""A run that fails with less space than this on the disk failed for want of space."""


class DiskFullError(RuntimeError):
    """There is no space left; what is finished is kept, what is not goes on from its last checkpoint."""


@dataclass(frozen=True)
class StudyResult:
    """Where a study stands after an invocation.

    Attributes:
        root: its folder.
        rows: the rows of ``results.csv``.
        errors: run name -> one line, for runs that failed in this invocation.
    """

    root: Path
    rows: list[dict[str, Any]]
    errors: dict[str, str]

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
    check_names(what)
    runs = what.runs()
    mine = runs[shard_of(shard)]
    configs = {run.name: what.config(run).to_dict() for run in mine}
    folder = StudyFolder(Path(out))
    with _full_disk_told():
        folder.claim(what, command)
        left = [run for run in mine if folder.run(run).final() is None]
        folder.write_results(what)
        jobs = [_job(folder, run, configs[run.name]) for run in left]
        errors = _carry_out(what, folder, {run.name: run for run in mine}, jobs, engine, stream) if jobs else {}
        return StudyResult(folder.root, folder.write_results(what), errors)


def make_engine(name: str, workers: int = 0, **of_ray: Any) -> Engine:
    """An engine by its name.

    Args:
        name: ``inline``, ``processes``, ``ray``, or ``auto`` (processes where there is more than one core).
        workers: how many runs at once, 0 for one a core, or what a cluster can take.
        of_ray: ``address``, ``cpus_per_run``, ``gpus_per_run``, ``retries``; see :class:`Ray`.

    Raises:
        ValueError: there is no such engine, or it has no such option.
        MissingPackage: ``ray`` is not installed.
    """
    if name == "ray":
        return Ray(workers, **of_ray)
    if wrong := [key for key, value in of_ray.items() if value != getattr(Ray, key)]:
        raise ValueError(f"--{wrong[0].replace('_', '-')} is for --engine ray, and the engine is {name}")
    if name == "processes" or (name == "auto" and len(available_cores()) > 1):
        return Processes(workers)
    if name in ("auto", "inline"):
        return Inline()
    raise ValueError(f"unknown engine {name!r}: allowed are {', '.join(ENGINES)}")


def check_names(what: Study) -> None:
    """Check that the games and memory models of a study exist.

    Raises:
        ValueError: one does not; the message names the nearest.
    """
    from arcade_torch.envs_jax import make
    from arcade_torch.models import make_memory, memory_names

    for game in what.games:
        make(game)
    for memory in what.memories:
        if memory not in (*memory_names(), "feedforward"):
            make_memory(memory, 1, 1)  # refuses it


def shard_of(text: str) -> slice:
    """The runs of a shard: ``3/10`` takes every tenth from the third; an empty text takes all.

    Raises:
        ValueError: it is no shard.
    """
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if text and (found is None or not 1 <= int(found[1]) <= int(found[2])):
        raise ValueError(f"a shard is written 3/10, the third of ten; got {text!r}")
    return slice(int(found[1]) - 1, None, int(found[2])) if found else slice(None)


def _job(folder: StudyFolder, run: RunSpec, config: Mapping[str, Any]) -> Job:
    file = write_json(folder.root / "configs" / f"{run.name}.json", config)
    return Job(run.name, file, folder.run(run).path, folder.log(run))


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
            if folder.run(run).final() is None:  # a process killed after its last word has done its work
                error = errors[result.name] = result.error or "ended without a final evaluation"
                display.note(f"{result.name} failed: {error} (log: {folder.log(run)})")
            folder.note_failure(run, error)
            folder.write_results(what)
            if error and ("No space left" in error or shutil.disk_usage(folder.root).free < LEAST_FREE_BYTES):
                raise DiskFullError(f"the disk with {folder.root} is full ({error}); make room and start it again")
    return errors


@contextlib.contextmanager
def _full_disk_told() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskFullError(f"{error.strerror}: {error.filename or 'the study'}; make room and start again") from error


class Display:
    """Shows how far a study is, from the ``progress.json`` of its runs: a bar for all and one for each run at work.

    Args:
        title: of the study.
        folders: run name -> folder.
        ended: names of the runs that have ended; the caller adds to it.
        stream: where to write, stderr by default.
    """

    def __init__(self, title: str, folders: Mapping[str, RunFolder], ended: set[str], stream: Any = None) -> None:
        self.title, self.folders, self.ended = title, folders, ended
        self.bars, self.speed, self.shown = Bars(stream, first_line_s=3.0), Speed(), set[str]()
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
        seen = {name: folder.progress() for name, folder in self.folders.items()}
        guess = next((progress.total_frames for progress in seen.values() if progress), 0)
        frames, total, terminal = 0, 0, self.bars.stream.isatty()
        for name, progress in seen.items():
            wanted = progress.total_frames if progress else guess
            done = wanted if name in self.ended else min(progress.frames, wanted) if progress else 0
            frames, total = frames + done, total + wanted
            if progress and progress.status == "running" and name not in self.ended and terminal:
                self.bars.update(f"  {name.replace('__', ' ')}", done, wanted)
                self.shown.add(name)
            elif name in self.shown:
                self.shown.remove(name)
                self.bars.remove(f"  {name.replace('__', ' ')}")
        speed = self.speed.update(time.monotonic(), frames)
        left = f", {clock((total - frames) / speed)} left" if speed > 0 and frames < total else ""
        pace = f", {speed:,.0f} frames/s" if speed > 0 else ""
        share = 100 * frames / total if total else 0
        runs = f"{len(self.ended)}/{len(self.folders)} runs"
        line = f"{runs}, {frames:,} of {total:,} frames ({share:.0f} %){pace}{left}"
        if terminal or frames < total:
            self.bars.update(self.title, frames, total or None, f"{runs}{pace}{left}", f"{self.title}: {line}")
        return line

    def _loop(self) -> None:
        while not self._stop.wait(0.5):
            self.show()
