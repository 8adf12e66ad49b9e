"""``arcade-torch study``."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from arcade_torch.tools.extensions import command_line

if TYPE_CHECKING:
    from arcade_torch.tools.studies.engines import Engine
    from arcade_torch.tools.studies.grid import Study


@dataclass
class StudyCommand:
    """Run a grid of trainings described by one TOML file; type the same again to go on after an interruption.

    The file names games, memories and seeds, and optionally observability, algorithms, preset, total_frames, baseline,
    sizes, question and a table [settings] with fields of the config that train takes.

    Example: arcade-torch study examples/studies/small-short.toml --out runs/mine --workers 4
    """

    file: tyro.conf.Positional[Path | None] = None
    """The study."""
    preset: Literal["demo", "paper-easy", "paper", "size-sweep"] | None = None
    """A ready-made study in the place of a file."""
    out: Path | None = None
    """Folder of the study; runs/NAME by default."""
    engine: Literal["auto", "inline", "processes", "ray"] = "auto"
    """Where the runs are carried out; auto takes processes where there is more than one core."""
    workers: int = 0
    """Runs at once; 0 for one a core, or for what the Ray cluster has room for."""
    address: str = ""
    """Ray: address of a cluster (auto, HOST:PORT); without one, a cluster of its own on this machine."""
    cpus_per_run: float = 1.0
    """Ray: cores that a run keeps busy."""
    gpus_per_run: float = 0.0
    """Ray: GPUs, or the part of one, that a run keeps busy."""
    retries: int = 2
    """Ray: further attempts at a run whose process or machine was lost."""
    shard: str = ""
    """3/10 carries out the third tenth of the runs, for the array jobs of a scheduler; all write into one folder."""
    dry_run: bool = False
    """Only print every run with its frames, and the frames of all together."""
    report: bool = True
    """Write the HTML report at the end; of shards, the one that finishes the study writes it."""
    argv: tyro.conf.Suppress[tuple[str, ...]] = ()

    def run(self) -> int:
        """Run the study; exit code 1 if a run failed."""
        from arcade_torch.tools.studies.grid import STUDY_PRESETS, Study, study_preset
        from arcade_torch.tools.studies.runner import make_engine, planned

        if (self.file is None) == (self.preset is None):
            raise ValueError(f"give a TOML file, or --preset with one of {', '.join(STUDY_PRESETS)}; one of the two")
        what = study_preset(self.preset) if self.preset is not None else Study.load(str(self.file))
        if self.dry_run:
            plan, total = planned(what, self.shard), 0
            for run, config in plan.items():
                frames = config.num_updates * config.learner.frames_per_update
                total += frames
                print(f"{run.name}  {frames:,} frames")
            print(f"{len(plan):,} runs, {total:,} frames in all", file=sys.stderr)
            return 0
        of_ray = {name: getattr(self, name) for name in ("address", "cpus_per_run", "gpus_per_run", "retries")}
        engine = make_engine(self.engine, self.workers, **of_ray)
        out = self.out or Path("runs") / what.name
        return carry_out(what, out, engine, self.command(), self.resume_hint(), self.shard, self.report)

    def command(self) -> str:
        """The line that started this study; without the shard, which is not the study's."""
        at = self.argv.index("--shard") if "--shard" in self.argv else len(self.argv)
        argv = [*self.argv[:at], *self.argv[at + 2 :]]
        return command_line(["study", *(word for word in argv if not word.startswith("--shard="))])

    def resume_hint(self) -> str:
        """What to type after an interruption."""
        line = command_line(["study", *self.argv])
        return f"finished runs are kept, the others go on from their checkpoints with: {line}"


def carry_out(
    what: "Study", out: Path, engine: "Engine | str", command: str, hint: str, shard: str = "", report: bool = True
) -> int:
    """Run a study, say how each run ended, and write the report; exit code 1 if a run failed."""
    from arcade_torch.tools.progress import Bars
    from arcade_torch.tools.studies.runner import DiskFullError, study

    try:
        result = study(what, out, engine, command=command, shard=shard)
    except DiskFullError as error:
        print(f"stopped: {error}; {hint}")
        return 1
    print(f"{result.finished} of {len(result.rows)} runs finished; table: {result.root / 'results.csv'}")
    for name, reason in result.errors.items():
        print(f"failed: {name}: {reason} (log: {result.root / 'logs' / f'{name}.log'})")
    if report and result.finished and (not shard or result.finished == len(result.rows)):
        from arcade_torch.tools.reports.build import report as write_report

        with Bars() as bars:
            page = write_report(result.root, progress=bars.update)
        print(f"report: {page.resolve()}")
    return 1 if result.errors else 0


COMMAND = StudyCommand
