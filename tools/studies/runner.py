"""Run a study: skip what is finished, resume what was interrupted, keep what others did when one fails."""

import contextlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from arcade_torch.tools.studies.engines import Engine, Job, JobResult, make_engine
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study
from arcade_torch.tools.studies.progress import Display, Watcher


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
) -> StudyResult:
    """Carry out a study, or go on with it.

    Finished runs are skipped, interrupted ones resumed from their last checkpoint, failed ones tried again.

    Args:
        what: a study or the path of its TOML file.
        out: folder of the study; made if it is missing, continued if it holds this study.
        engine: where the runs are carried out: ``auto``, ``inline``, ``processes`` or an object with a method ``run``.
        workers: for ``processes``: how many at once, 0 for one a core.
        command: how the user started this, kept in ``study.json``.
        stream: where progress is shown, stderr by default.

    Returns:
        The rows of ``results.csv`` and the errors of this invocation.

    Raises:
        FileNotFoundError: there is no such file.
        FileExistsError: ``out`` holds something else.
        ValueError: the study names a game or a memory model that does not exist, or is no study.
        FileExistsError: also if another process is at work in this folder.
    """
    what = what if isinstance(what, Study) else Study.load(what)
    engine = make_engine(engine, workers) if isinstance(engine, str) else engine
    check_names(what)
    folder = StudyFolder(Path(out))
    with _only_one(folder.root):
        folder.claim(what, command)
        errors = _carry_out(what, folder, engine, stream)
        return StudyResult(folder.root, folder.write_results(what, errors), errors)


def check_names(what: Study) -> None:
    """Check that the games and memory models of a study exist.

    Raises:
        ValueError: one does not; the message names the nearest.
    """
    import difflib

    from arcade_torch.envs_jax import make
    from arcade_torch.models import memory_names

    for game in what.games:
        make(game)
    known = list(memory_names())
    for memory in what.memories:
        if memory not in known:
            near = difflib.get_close_matches(memory, known, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise ValueError(f"unknown memory model {memory!r}: {hint}known are {', '.join(known)}")


def _carry_out(what: Study, folder: StudyFolder, engine: Engine, stream: Any) -> dict[str, str]:
    runs = {run.name: run for run in what.runs()}
    todo = [run for run in runs.values() if folder.run(run).final() is None]
    watcher = Watcher({name: folder.run(run) for name, run in runs.items()}, what.total_frames or 0)
    watcher.ended = set(runs) - {run.name for run in todo}
    folder.write_results(what)
    errors: dict[str, str] = {}
    if not todo:
        return errors
    jobs = [_job(what, folder, run) for run in todo]
    with Display(watcher, what.name, stream=stream) as display, contextlib.closing(_iterate(engine, jobs)) as results:
        if watcher.ended:
            display.note(f"{len(watcher.ended)} of {len(runs)} runs are finished already")
        for result in results:
            watcher.ended.add(result.name)
            if result.exit_code or folder.run(runs[result.name]).final() is None:
                errors[result.name] = result.error or "ended without a final evaluation"
                display.note(f"{result.name} failed: {errors[result.name]} (log: {folder.log(runs[result.name])})")
            folder.write_results(what, errors)
    return errors


def _iterate(engine: Engine, jobs: list[Job]) -> Generator[JobResult, None, None]:
    yield from engine.run(jobs)


def _job(what: Study, folder: StudyFolder, run: RunSpec) -> Job:
    words = [*what.arguments(run, folder.run(run).path), "--resume"]  # starts a run that is not there yet
    return Job(run.name, tuple(words), folder.log(run))


@contextlib.contextmanager
def _only_one(root: Path) -> Iterator[None]:
    """Hold the folder's lock; the system lets go of it however the process ends."""
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    root.parent.mkdir(parents=True, exist_ok=True)
    file: IO[str]
    with (root.parent / f".{root.name}.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise FileExistsError(
                f"another process is at work on the study in {root}: wait for it, or stop it"
            ) from None
        yield
