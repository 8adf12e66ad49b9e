"""The folder of a study.

::

    study.json            the study, its versions, the command of every run; beside it the lock
                          that is held while it is first written
    configs/NAME.json     the config of a run, which `arcade-torch train --config` takes
    results.csv           one row a run, in the order of the grid; the same to the bit on every
                          engine, interrupted or not
    timings.csv           seconds of every run
    runs/NAME/            one run folder each (see `arcade_torch.agents`)
    logs/NAME.log         what the run printed, or why it failed
    failures/NAME.json    the same in one line; gone when the run succeeds
    analysis/             numbers and figures made from the runs
    report.html
"""

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_fields
from arcade_torch.agents.runs.files import read_json, write_json
from arcade_torch.agents.runs.lock import locked
from arcade_torch.envs_jax import resolve_id
from arcade_torch.tools.files import write_csv
from arcade_torch.tools.imports import imports_of, is_as_it_was
from arcade_torch.tools.machine import versions
from arcade_torch.tools.names import bare_name, preset_size
from arcade_torch.tools.options import command_line
from arcade_torch.tools.runs import FREE, Run, described, read_record
from arcade_torch.tools.studies.engines import Job
from arcade_torch.tools.studies.grid import RunSpec, Study

LOCK_LIMIT_S = 60.0
"""So long another process may take to begin a study in the same folder."""
_BEGINS_WITH = ("study.json", "study.json.lock")
Row = dict[str, Any]
_CELL = ("game", "observability", "memory", "agent", "algorithm", "seed")
RESULT_COLUMNS = (
    "run",
    *_CELL,
    "status",
    "frames",
    "eval_mean",
    "eval_std",
    "eval_n",
    "train_max_ewm",
    "error",
)
TIMING_COLUMNS = ("run", "frames", "seconds")


@dataclass(frozen=True)
class StudyFolder:
    """A study on disk."""

    root: Path

    def job(self, spec: RunSpec) -> Job:
        """Where the config, the folder and the log of a run stand."""
        config = self.root / "configs" / f"{spec.name}.json"
        log = self.root / "logs" / f"{spec.name}.log"
        return Job(spec.name, config, self.root / "runs" / spec.name, log)

    def run(self, spec: RunSpec) -> Run:
        """The folder of one run, as it is now."""
        return Run(self.job(spec).folder)

    @property
    def analysis(self) -> Path:
        """Folder for numbers and figures made from the runs."""
        return self.root / "analysis"

    @property
    def is_writable(self) -> bool:
        """Whether files may be written here; the study of somebody else may be read alone."""
        return os.access(self.root, os.W_OK)

    def keep_table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write a table into `analysis`, where files may be written."""
        if self.is_writable:
            write_csv(self.analysis / name, rows)

    def note_failure(self, spec: RunSpec, error: str) -> None:
        """Keep why a run failed, or forget it where ``error`` is empty."""
        file = self.root / "failures" / f"{spec.name}.json"
        if error:
            write_json(file, {"error": error})
        else:
            file.unlink(missing_ok=True)

    def record(self) -> dict[str, Any]:
        """All of ``study.json``."""
        return read_record(self.root / "study.json")

    def load(self) -> Study:
        """The study that was run here; a ``FileNotFoundError`` or ``ValueError`` if there is none
        to read.
        """
        file = self.root / "study.json"
        if not file.exists():
            raise FileNotFoundError(
                f"{self.root} is not the folder of a study: it has no study.json"
            )
        values = read_json(file)
        try:
            return Study.from_dict(values["study"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file} does not describe a study: {error}") from error

    def claim(self, study: Study, command: str = "") -> None:
        """Write ``study.json``, or go on where the same study stands already.

        The grid may grow between two invocations; what decides a run's result may not change. A
        ``study.json`` that is not even JSON is written anew: the run folders know what they hold
        and refuse other settings themselves. A folder with other files, or a study or a finished
        run with other settings, is refused by a ``FileExistsError``.
        """
        file = self.root / "study.json"
        if not file.exists():
            self._begin(study, command)
        old: dict[str, Any] = {}
        with contextlib.suppress(ValueError):
            old = self.record()
        if old:
            self._check_same(self.load(), study)
        runs = {spec: self.run(spec) for spec in study.runs()}  # each is read once
        _check_finished(study, runs)
        _check_begun(study, runs)
        new = self._new_record(study, command, old)
        if new != old:
            write_json(file, new)

    def _begin(self, study: Study, command: str) -> None:
        """Write ``study.json`` where there is none, one process after the other: of two studies
        that begin in one folder the second finds the first.
        """
        file = self.root / "study.json"
        self._check_empty()
        with locked(file, LOCK_LIMIT_S):
            if not file.exists():
                self._check_empty()
                write_json(file, self._new_record(study, command, {}))

    def _check_empty(self) -> None:
        """Refuse a folder of other files than those that another shard writes as it begins."""
        if not self.root.exists():
            return
        for path in self.root.iterdir():
            is_ours = path.name.startswith(".study.json.") or path.name in _BEGINS_WITH
            if not is_ours or path.is_symlink():
                raise FileExistsError(
                    f"{self.root} is not empty and holds no study: choose another --out"
                )

    def _check_same(self, before: Study, study: Study) -> None:
        """Refuse a study that has other settings than the one that stands here, or fewer runs."""
        was = before.fixed()
        now = study.fixed()
        for name in now:
            if was[name] != now[name]:
                raise FileExistsError(
                    f"{self.root} holds study {before.name!r} with {name} = {was[name]!r}, not "
                    f"{now[name]!r}: choose another --out"
                )
        names = {run.name for run in study.runs()}
        for run in before.runs():
            if run.name not in names:
                raise FileExistsError(
                    f"{self.root} holds run {run.name}, which this study lacks"
                    f"{_narrower(before, study) or ':'} choose another --out"
                )

    def _new_record(self, study: Study, command: str, old: dict[str, Any]) -> dict[str, Any]:
        """What ``study.json`` is to hold; the versions of the first runs stay on record."""
        commands = dict[str, str]()
        for run in study.runs():
            job = self.job(run)
            commands[job.name] = command_line(["train", *job.words])
        current = versions()
        first = old.get("versions", current)
        also = old.get("also")
        also = list(also) if isinstance(also, list) else []
        if current not in (first, *also):
            also.append(current)
        return {
            "study": study.to_dict(),
            "command": command,
            "versions": first,
            "also": also,
            "runs": commands,
        }

    def write_results(self, study: Study, finished: dict[RunSpec, Row] | None = None) -> list[Row]:
        """Write ``results.csv`` and ``timings.csv`` from the run folders; returns the rows of both,
        joined. A ``ValueError`` names a folder that holds another run than its name says.

        ``finished`` keeps the rows of finished runs from one call to the next: they are not read
        again.
        """
        rows = self.rows(study, finished)
        write_csv(self.root / "results.csv", rows, RESULT_COLUMNS)
        timed = [row for row in rows if row["seconds"] is not None]
        write_csv(self.root / "timings.csv", timed, TIMING_COLUMNS)
        return rows

    def rows(self, study: Study, finished: dict[RunSpec, Row] | None = None) -> list[Row]:
        """The rows that `write_results` writes, of a folder that is left as it is."""
        finished = {} if finished is None else finished
        rows = list[Row]()
        for run in study.runs():
            row = finished.get(run) or self._row(run)
            if row["status"] == "finished":
                finished[run] = row
            rows.append(row)
        return rows

    def _row(self, spec: RunSpec) -> Row:
        run = self.run(spec)
        row: Row = dict.fromkeys((*RESULT_COLUMNS, *TIMING_COLUMNS))
        row["run"] = spec.name
        row["frames"] = run.progress()[0]
        for name in _CELL:
            row[name] = getattr(spec, name)
        final = run.final
        if final:
            _check_cell(run, spec)
            row |= _final_columns(final)
            row["status"] = "finished"
            row["error"] = ""
        else:
            row["error"] = self._failure(spec)
            unfinished = "unfinished" if run.path.exists() else "waiting"
            row["status"] = "failed" if row["error"] else unfinished
        return row

    def _failure(self, spec: RunSpec) -> str:
        """Why a run failed; empty if it did not, or its file is damaged."""
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            return str(read_json(self.root / "failures" / f"{spec.name}.json")["error"])
        return ""


def _narrower(before: Study, study: Study) -> str:
    """Which axis of a study lost values, and how to have them again; empty if none did."""
    for axis in ("games", "memories", "observability", "algorithms", "sizes"):
        now = list(getattr(study, axis))
        lost = [value for value in getattr(before, axis) if value not in now]
        if lost:
            return f" ({axis} = {now}, without {', '.join(lost)}): add it, or"
    return ""


def _check_finished(study: Study, runs: Mapping[RunSpec, Run]) -> None:
    """Refuse a finished run that has other settings than the study says."""
    finished = [spec for spec, run in runs.items() if run.final is not None]
    for spec, config in study.configs(finished).items():
        run = runs[spec]
        fields = _other_settings(run, config)
        if fields:
            raise FileExistsError(
                f"{run.path} has other settings, {', '.join(fields)}: choose another --out"
            )
        _check_imports(run, config)


def _check_begun(study: Study, runs: Mapping[RunSpec, Run]) -> None:
    """Refuse to go on from the checkpoint of another text of an imported file."""
    begun = list[RunSpec]()
    for spec, run in runs.items():
        if run.final is None and any(run.path.glob("checkpoints/frames-*")):
            begun.append(spec)
    for spec, config in study.configs(begun).items():
        with contextlib.suppress(ValueError, FileNotFoundError):  # told when it goes on
            _check_imports(runs[spec], config)


def _check_cell(run: Run, spec: RunSpec) -> None:
    """Refuse the folder of a run that holds another one than its name says."""
    key = described(run).key
    held = [bare_name(run.game), run.twin, key.memory, key.algorithm, run.seed]
    named = [bare_name(spec.game), spec.observability, spec.memory, spec.algorithm, spec.seed]
    if spec.size:
        held.append(key.size or preset_size(key.network))
        named.append(spec.size)
    if held != named:
        raise ValueError(
            f"{run.path} holds a run of {', '.join(map(str, held))}, not of "
            f"{', '.join(map(str, named))}: give it the name of its own run, or delete it"
        )


def _final_columns(final: Mapping[str, Any]) -> Row:
    """The columns of a finished run."""
    columns = Row()
    for name in ("frames", "seconds", "train_max_ewm"):
        if name in final:
            columns[name] = final[name]
    mean = float(final["mean"])
    returns = [float(value) for value in final["returns"]]
    columns["eval_mean"] = mean
    columns["eval_n"] = len(returns)
    if len(returns) > 1:  # one episode has no spread
        squares = sum((value - mean) ** 2 for value in returns)
        columns["eval_std"] = (squares / (len(returns) - 1)) ** 0.5
    return columns


def _check_imports(run: Run, plan: TrainConfig) -> None:
    """Refuse a run that was trained with a file that is imported otherwise, or not at all, now."""
    now = {entry["sha256"] for entry in imports_of(plan)}
    for name, sha256 in run.imports.items():
        if sha256 not in now and not is_as_it_was(name, sha256):
            raise FileExistsError(
                f"{run.path} was trained with {name} as it was before it changed: put it back, "
                "delete that folder to train the run anew, or choose another --out"
            )


def _other_settings(run: Run, plan: TrainConfig) -> list[str]:
    """In what a run differs from its plan that may change its result; damaged settings are
    refused.
    """
    described(run)
    config = run.config | {"env": resolve_id(run.game)}
    return differing_fields(config, replace(plan, env=resolve_id(plan.env)), FREE)
