"""``arcade-torch study``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from arcade_torch.tools.extensions import command_line


@dataclass
class StudyCommand:
    """Run a grid of trainings described by one TOML file; type the same again to go on after an interruption.

    The file names games, memories and seeds, and optionally observability, algorithms, preset, total_frames, baseline,
    question and a table [settings] with options of train.

    Example: arcade-torch study examples/study.toml --out runs/mine --workers 4
    """

    file: tyro.conf.Positional[Path]
    """The study."""
    out: Path | None = None
    """Folder of the study; runs/NAME by default."""
    engine: Literal["auto", "inline", "processes"] = "auto"
    """Where the runs are carried out; auto takes processes where there is more than one core."""
    workers: int = 0
    """Processes at once; 0 for one a core."""
    dry_run: bool = False
    """Only print the command of every run."""
    report: bool = True
    """Write the HTML report at the end."""

    def run(self) -> int:
        """Run the study; exit code 1 if a run failed."""
        from arcade_torch.tools.studies.folder import StudyFolder
        from arcade_torch.tools.studies.grid import Study
        from arcade_torch.tools.studies.runner import study

        what = Study.load(self.file)
        out = self.out or Path("runs") / what.name
        if self.dry_run:
            for spec in what.runs():
                print(what.command(spec, StudyFolder(out).run(spec).path))
            return 0
        result = study(what, out, self.engine, self.workers, self.command())
        print(f"{result.finished} of {len(result.rows)} runs finished; table: {result.root / 'results.csv'}")
        for name, error in result.errors.items():
            print(f"failed: {name}: {error}")
        if self.report and result.finished:
            from arcade_torch.tools.reports.build import report

            print(f"report: {report(result.root)}")
        return 1 if result.errors else 0

    def command(self) -> str:
        """The line that starts this study."""
        words = ["study", str(self.file)]
        words += ["--out", str(self.out)] if self.out else []
        return command_line([*words, "--engine", self.engine, "--workers", str(self.workers)])

    def how_to_go_on(self) -> str:
        """What to type after an interruption."""
        return f"finished runs are kept, the others go on from their checkpoints with: {self.command()}"


COMMAND = StudyCommand
