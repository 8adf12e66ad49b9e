"""``arcade-torch study``, ``demo``, a small one, and ``report``, its page."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from arcade_torch.tools.extensions import command_line

if TYPE_CHECKING:
    from arcade_torch.tools.studies.engines import Engine
    from arcade_torch.tools.studies.grid import Study

GO_ON = "finished runs are kept, the others go on from their checkpoints with: "


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
        at = self.argv.index("--shard") if "--shard" in self.argv else len(self.argv)  # it is not the study's
        argv = [word for word in (*self.argv[:at], *self.argv[at + 2 :]) if not word.startswith("--shard=")]
        line = command_line(["study", *argv])
        return carry_out(what, out, engine, line, self.resume_hint(), self.shard, self.report)

    def resume_hint(self) -> str:
        """What to type after an interruption."""
        return GO_ON + command_line(["study", *self.argv])


@dataclass
class Demo:
    """Small study of what memory does: one game as MDP and POMDP, with a memory and without, four seeds each.

    Ends in one HTML page with learning curves, observability gap, memory bias and saliency. About four minutes on two
    cores; type the same again to go on after an interruption. The game is a probe, solved with memory and only with it;
    with one of the ten games it takes longer and says less clearly.

    Example: arcade-torch demo --game MineSweeperEasy --frames 400000 --seeds 2 --out runs/mines
    """

    game: str = "SignpostEasy"
    """Game to play; of the ten, MineSweeperEasy learns something in 400000 frames."""
    frames: int = 100_000
    """Environment steps of each run."""
    seeds: int = 4
    """Runs of each agent and twin."""
    out: Path = Path("runs/demo")
    """Folder of the study."""
    workers: int = 0
    """Runs at once; 0 for one a core."""
    argv: tyro.conf.Suppress[tuple[str, ...]] = ()

    def run(self) -> int:
        """Run the study and write its report."""
        from arcade_torch.tools.studies.grid import demo_study
        from arcade_torch.tools.studies.runner import make_engine

        what = demo_study(self.game, self.frames, self.seeds)
        line = command_line(["demo", *self.argv])
        return carry_out(what, self.out, make_engine("auto", self.workers), line, self.resume_hint())

    def resume_hint(self) -> str:
        """What to type after an interruption."""
        return GO_ON + command_line(["demo", *self.argv])


@dataclass
class Report:
    """Write the HTML page of a study: one file, nothing loaded from elsewhere. Missing analyses are made first.

    Example: arcade-torch report runs/demo
    """

    study: tyro.conf.Positional[Path]
    """Folder of the study."""
    out: Path | None = None
    """The page; report.html in that folder by default."""
    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run that the headline is based on."""
    saliency: bool = True
    """Draw saliency strips."""
    recall: bool = True
    """Measure recall density: how decisions spread over the past."""
    contamination: bool = True
    """Measure state contamination: what one noisy past frame changes."""
    references: bool = True
    """Draw the returns of the random policy and of the oracles."""

    def run(self) -> int:
        """Write the page."""
        sections = {name: getattr(self, name) for name in ("saliency", "recall", "contamination", "references")}
        write_page(self.study, self.out, metric=self.metric, **sections)
        return 0


def carry_out(
    what: "Study", out: Path, engine: "Engine | str", command: str, hint: str, shard: str = "", report: bool = True
) -> int:
    """Run a study, say how each run ended, and write the report; exit code 1 if a run failed."""
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
        write_page(result.root)
    return 1 if result.errors else 0


def write_page(study: Path, out: Path | None = None, **how: Any) -> None:
    """Write the report of a study, and say where it is."""
    from arcade_torch.tools.progress import Bars
    from arcade_torch.tools.reports import report

    with Bars() as bars:
        print(f"report: {report(study, out, progress=bars.update, **how).resolve()}")


COMMANDS = {"study": StudyCommand, "demo": Demo, "report": Report}
