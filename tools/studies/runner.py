"""Run a study: skip what is finished, resume what was interrupted, keep what others did when one fails."""

import contextlib
import errno
import shutil
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arcade_torch.tools.studies.engine_names import make_engine
from arcade_torch.tools.studies.engines import Engine, JobResult
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from arcade_torch.tools.studies.progress import Display, Watcher
from arcade_torch.tools.studies.queue import RunQueue

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
) -> StudyResult:
    """Carry out a study, or go on with it.

    Finished runs are skipped, interrupted ones resumed from their last checkpoint, failed ones tried again. Several
    processes, on any machines that see the folder, may carry out one study together: each run is done by one of them,
    by another if that one is lost, and all return when the last run has ended.

    Args:
        what: a study or the path of its TOML file.
        out: folder of the study; made if it is missing, continued if it holds this study.
        engine: where the runs are carried out: ``auto``, ``inline``, ``processes``, ``ray`` or an object with a
            method ``run``.
        workers: how many runs at once, 0 for one a core.
        command: how the user started this, kept in ``study.json``.
        stream: where progress is shown, stderr by default.

    Returns:
        The rows of ``results.csv`` and the errors of this invocation.

    Raises:
        FileNotFoundError: there is no such file.
        FileExistsError: ``out`` holds something else.
        ValueError: the study names a game or a memory model that does not exist, or is no study.
        DiskFullError: there is no space left for results; what is finished is kept.
    """
    what = what if isinstance(what, Study) else Study.load(what)
    engine = make_engine(engine, workers) if isinstance(engine, str) else engine
    check_names(what)
    folder = StudyFolder(Path(out))
    with _full_disk_told():
        folder.claim(what, command)
        errors = _carry_out(what, folder, engine, stream)
        return StudyResult(folder.root, folder.write_results(what), errors)


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
    watcher = Watcher({name: folder.run(run) for name, run in runs.items()}, what.total_frames or 0)
    errors: dict[str, str] = {}

    def by_others(name: str, error: str) -> None:
        watcher.ended.add(name)
        if error:
            errors[name] = error

    with contextlib.closing(RunQueue(what, folder, by_others)) as queue:
        watcher.ended |= set(runs) - queue.names
        folder.write_results(what)
        if not queue.names:
            return errors
        with Display(watcher, what.name, stream=stream) as display, contextlib.closing(_iterate(engine, queue)) as ends:
            if watcher.ended:
                display.note(f"{len(watcher.ended)} of {len(runs)} runs are finished already")
            for result in ends:
                run = runs[result.name]
                watcher.ended.add(result.name)
                if folder.run(run).final() is None:  # a process killed after its last word has done its work
                    errors[result.name] = result.error or "ended without a final evaluation"
                    display.note(f"{result.name} failed: {errors[result.name]} (log: {folder.log(run)})")
                    _check_space(folder.root, errors[result.name])
                queue.done(result.name, errors.get(result.name, ""))
                folder.write_results(what)
    return errors


def _iterate(engine: Engine, queue: RunQueue) -> Generator[JobResult, None, None]:
    yield from engine.run(queue)


def _check_space(root: Path, error: str) -> None:
    """Stop the study where the disk is full, instead of failing at one run after the other."""
    if "No space left" in error or shutil.disk_usage(root).free < LEAST_FREE_BYTES:
        raise DiskFullError(f"the disk with {root} is full ({error}); make room and start the study again")


@contextlib.contextmanager
def _full_disk_told() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskFullError(f"{error.strerror}: {error.filename or 'the study'}; make room and start again") from error
