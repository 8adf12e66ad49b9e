"""The folder of a study, and what stands in the folders of its runs.

::

    study.json    the study, its versions, the command of every run
    configs/NAME.json  the config of a run, which `arcade-torch train --config` takes
    results.csv   one row a run, in the order of the grid; the same to the bit on every engine, interrupted or not
    timings.csv   seconds of every run
    runs/NAME/    one run folder each (see `arcade_torch.agents`)
    logs/NAME.log what the run printed, or why it failed
    failures/NAME.json the same in one line; gone when the run succeeds
    analysis/     numbers and figures made from the runs
    report.html
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arcade_torch.agents.runs.files import is_final
from arcade_torch.agents.runs.files import read_csv as read_log
from arcade_torch.tools.files import read_json, write_csv, write_json
from arcade_torch.tools.studies.grid import RunSpec, Study
from arcade_torch.tools.versions import versions

_CELL = ("game", "observability", "memory", "agent", "algorithm", "seed")
_SCORES = ("eval_mean", "eval_std", "eval_n", "train_max_ewm")
RESULT_COLUMNS = ("run", *_CELL, "status", "frames", *_SCORES, "error")
TIMING_COLUMNS = ("run", "frames", "seconds")


@dataclass(frozen=True)
class Progress:
    """How far a run is: environment steps done and wanted, and its status."""

    frames: int
    total_frames: int
    status: str


@dataclass(frozen=True)
class RunFolder:
    """Read access to one run's folder; missing files mean "not yet"."""

    path: Path

    def exists(self) -> bool:
        """Whether a run was ever started here."""
        return (self.path / "config.json").exists() or (self.path / "progress.json").exists()

    def final(self) -> dict[str, Any] | None:
        """The content of ``eval.json`` if the run has finished, else None; a damaged file counts as none."""
        try:
            values = read_json(self.path / "eval.json")
        except (OSError, ValueError):
            return None
        return values if is_final(values) else None

    def progress(self) -> Progress | None:
        """What ``progress.json`` says, or None; a file just being replaced counts as none."""
        try:
            values = read_json(self.path / "progress.json")
            return Progress(int(values["frames"]), int(values["total_frames"]), str(values.get("status", "running")))
        except (OSError, ValueError, KeyError, TypeError, OverflowError):
            return None

    def config(self) -> dict[str, Any]:
        """The resolved settings of the run, flat or nested as the trainer wrote them."""
        values = self.record()
        inner = values.get("config", values)
        return dict(inner) if isinstance(inner, dict) else {}

    def record(self) -> dict[str, Any]:
        """All of ``config.json``: settings, versions, command.

        Raises:
            ValueError: it is damaged.
        """
        return _table(self.path / "config.json")

    def table(self, name: str) -> list[dict[str, str]]:
        """Rows of ``metrics.csv`` or ``eval.csv``; none if there is no such file."""
        file = self.path / name
        return read_log(file) if file.exists() else []


@dataclass(frozen=True)
class StudyFolder:
    """A study on disk."""

    root: Path

    def run(self, spec: RunSpec) -> RunFolder:
        """The folder of one run."""
        return RunFolder(self.root / "runs" / spec.name)

    def log(self, spec: RunSpec) -> Path:
        """File with what the run printed."""
        return self.root / "logs" / f"{spec.name}.log"

    @property
    def analysis(self) -> Path:
        """Folder for numbers and figures made from the runs."""
        return self.root / "analysis"

    def failure(self, spec: RunSpec) -> str:
        """Why the last attempt at a run failed; empty if it did not."""
        try:
            return str(read_json(self.root / "failures" / f"{spec.name}.json")["error"])
        except (OSError, ValueError, KeyError, TypeError):
            return ""

    def note_failure(self, spec: RunSpec, error: str) -> None:
        """Keep why a run failed, or forget it where ``error`` is empty."""
        file = self.root / "failures" / f"{spec.name}.json"
        if error:
            write_json(file, {"error": error})
        else:
            file.unlink(missing_ok=True)

    def load(self) -> Study:
        """The study that was run here.

        Raises:
            FileNotFoundError: this is no study's folder.
            ValueError: ``study.json`` is damaged.
        """
        file = self.root / "study.json"
        if not file.exists():
            raise FileNotFoundError(f"{self.root} is not the folder of a study: it has no study.json")
        values = read_json(file)
        try:
            return Study.from_dict(values["study"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file} does not describe a study: {error}") from error

    def record(self) -> dict[str, Any]:
        """All of ``study.json``."""
        return _table(self.root / "study.json")

    def claim(self, study: Study, command: str = "") -> None:
        """Write ``study.json``, or go on where the same study stands already.

        The grid may grow between two invocations; what decides a run's result may not change. A ``study.json`` that is
        not even JSON is written anew: the run folders know what they hold and refuse other settings themselves.

        Raises:
            FileExistsError: the folder holds other files, or a study with other settings.
        """
        old: dict[str, Any] = {}
        if (self.root / "study.json").exists():
            try:
                old = self.record()
            except ValueError:
                old = {}
            if old:
                self._check_same(self.load(), study)
        elif self.root.exists() and not all(entry.name.startswith(".study.json.") for entry in self.root.iterdir()):
            raise FileExistsError(f"{self.root} is not empty and holds no study: choose another --out")
        commands = {run.name: study.command(run, self.run(run).path) for run in study.runs()}
        # What the first runs were made with stays on record.
        now = versions()
        first, also = old.get("versions", now), list(old["also"]) if isinstance(old.get("also"), list) else []
        also += [] if now in (first, *also) else [now]
        made = {"study": study.to_dict(), "command": command, "versions": first, "also": also, "runs": commands}
        if made != old:
            write_json(self.root / "study.json", made)

    def _check_same(self, before: Study, study: Study) -> None:
        for key, old in before.fixed().items():
            if old != study.fixed()[key]:
                raise FileExistsError(
                    f"{self.root} holds study {before.name!r} with {key} = {old!r}, not {study.fixed()[key]!r}: "
                    "choose another --out"
                )
        names = {run.name for run in study.runs()}
        if gone := [run.name for run in before.runs() if run.name not in names]:
            raise FileExistsError(f"{self.root} holds run {gone[0]}, which this study lacks: choose another --out")

    def write_results(self, study: Study) -> list[dict[str, Any]]:
        """Write ``results.csv`` and ``timings.csv`` from the run folders.

        Args:
            study: gives the order of the rows.

        Returns:
            The rows of both, joined.
        """
        rows = [self._row(run) for run in study.runs()]
        write_csv(self.root / "results.csv", rows, RESULT_COLUMNS)
        write_csv(self.root / "timings.csv", [row for row in rows if row.get("seconds") is not None], TIMING_COLUMNS)
        return rows

    def _row(self, run: RunSpec) -> dict[str, Any]:
        folder = self.run(run)
        final, progress = folder.final(), folder.progress()
        error = "" if final else self.failure(run)
        row: dict[str, Any] = dict.fromkeys((*RESULT_COLUMNS, *TIMING_COLUMNS))
        row |= {"run": run.name, "error": error} | {name: getattr(run, name) for name in _CELL}
        row["status"] = "finished" if final else "failed" if error else "unfinished" if folder.exists() else "waiting"
        row["frames"] = progress.frames if progress else 0
        if final:
            returns = [float(value) for value in final.get("returns", [])]
            mean = float(final["mean"]) if "mean" in final else sum(returns) / len(returns)
            spread = (sum((value - mean) ** 2 for value in returns) / max(1, len(returns) - 1)) ** 0.5
            row |= {
                "frames": final.get("frames", row["frames"]),
                "seconds": final.get("seconds"),
                "eval_mean": mean,
                "eval_std": spread if returns else final.get("std"),
                "eval_n": len(returns) or final.get("n"),
                "train_max_ewm": final.get("train_max_ewm"),
            }
        return row


def _table(file: Path) -> dict[str, Any]:
    values = read_json(file)
    if not isinstance(values, dict):
        raise ValueError(f"{file} is damaged: it holds no table of names and values")
    return values
