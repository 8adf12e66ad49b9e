"""The folder of a study.

::

    study.json    the study, its versions, the command of every run
    configs/NAME.json  the config of a run, which `arcade-torch train --config` takes
    results.csv   one row a run, in the order of the grid; the same to the bit on every engine,
    interrupted or not timings.csv   seconds of every run
    runs/NAME/    one run folder each (see `arcade_torch.agents`)
    logs/NAME.log what the run printed, or why it failed
    failures/NAME.json the same in one line; gone when the run succeeds
    analysis/     numbers and figures made from the runs
    report.html
"""

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from arcade_torch.agents.config import TrainConfig, differing_fields
from arcade_torch.agents.runs.files import read_json, write_json
from arcade_torch.envs_jax import resolve_id
from arcade_torch.tools.comparable import FREE
from arcade_torch.tools.files import write_csv
from arcade_torch.tools.machine import versions
from arcade_torch.tools.options import command_line
from arcade_torch.tools.runs import Run, described, read_record
from arcade_torch.tools.studies.engines import Job
from arcade_torch.tools.studies.grid import RunSpec, Study

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
        old: dict[str, Any] = {}
        # Looked at before study.json, which another shard may be about to write.
        foreign = self.root.exists() and not all(
            each.name.startswith(".study.json.") for each in self.root.iterdir()
        )
        if (self.root / "study.json").exists():
            with contextlib.suppress(ValueError):
                old = self.record()
            before = self.load() if old else study
            was = before.fixed()
            now = study.fixed()
            names = {run.name for run in study.runs()}
            what = [
                f"study {before.name!r} with {k} = {was[k]!r}, not {now[k]!r}"
                for k in now
                if was[k] != now[k]
            ]
            what += [
                f"run {run.name}, which this study lacks"
                for run in before.runs()
                if run.name not in names
            ]
            if what:
                raise FileExistsError(f"{self.root} holds {what[0]}: choose another --out")
        elif foreign:
            raise FileExistsError(
                f"{self.root} is not empty and holds no study: choose another --out"
            )
        finished = [spec for spec in study.runs() if self.run(spec).final is not None]
        for spec, config in study.configs(finished).items():
            run = self.run(spec)
            if fields := _other_settings(run, config):
                raise FileExistsError(
                    f"{run.path} has other settings, {', '.join(fields)}: choose another --out"
                )
        jobs = [self.job(run) for run in study.runs()]
        commands = {job.name: command_line(["train", *job.words]) for job in jobs}
        here = versions()
        # what the first runs were made with stays on record
        first = old.get("versions", here)
        also = old.get("also")
        also = list(also) if isinstance(also, list) else []
        also += [] if here in (first, *also) else [here]
        made = {
            "study": study.to_dict(),
            "command": command,
            "versions": first,
            "also": also,
            "runs": commands,
        }
        if made != old:
            write_json(self.root / "study.json", made)

    def write_results(self, study: Study, finished: dict[RunSpec, Row] | None = None) -> list[Row]:
        """Write ``results.csv`` and ``timings.csv`` from the run folders; returns the rows of both,
        joined.

        ``finished`` keeps the rows of finished runs from one call to the next: they are not read
        again.
        """
        finished = {} if finished is None else finished
        rows = list[Row]()
        for run in study.runs():
            row = finished.get(run) or self._row(run)
            if row["status"] == "finished":
                finished[run] = row
            rows.append(row)
        write_csv(self.root / "results.csv", rows, RESULT_COLUMNS)
        write_csv(
            self.root / "timings.csv",
            [row for row in rows if row["seconds"] is not None],
            TIMING_COLUMNS,
        )
        return rows

    def _row(self, spec: RunSpec) -> Row:
        run = self.run(spec)
        error = ""
        row: Row = dict.fromkeys((*RESULT_COLUMNS, *TIMING_COLUMNS))
        row |= {"run": spec.name, "frames": run.progress()[0]} | {
            name: getattr(spec, name) for name in _CELL
        }
        if final := run.final:
            mean = float(final["mean"])
            returns = [float(value) for value in final["returns"]]
            squares = sum((value - mean) ** 2 for value in returns)
            # of one episode there is none
            spread = (squares / (len(returns) - 1)) ** 0.5 if len(returns) > 1 else None
            row |= {
                name: final[name]
                for name in ("frames", "seconds", "train_max_ewm")
                if name in final
            }
            row |= {"eval_mean": mean, "eval_std": spread, "eval_n": len(returns)}
        else:
            # there is none, or it is damaged
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                error = str(read_json(self.root / "failures" / f"{spec.name}.json")["error"])
        begun = "unfinished" if run.path.exists() else "waiting"
        return row | {
            "error": error,
            "status": "finished" if final else "failed" if error else begun,
        }


def _other_settings(run: Run, plan: TrainConfig) -> list[str]:
    """In what a run differs from its plan that may change its result; damaged settings are
    refused.
    """
    described(run)
    return differing_fields(
        run.config | {"env": resolve_id(run.game)}, replace(plan, env=resolve_id(plan.env)), FREE
    )
