"""``arcade-torch study``, ``demo``, a small one, and ``report``, its page."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import check_writable
from arcade_torch.tools.figures import Part
from arcade_torch.tools.options import Command, command_line
from arcade_torch.tools.studies.engines import Engine, Inline, RayOptions
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import STUDY_PRESETS, Study, demo_study, study_preset
from arcade_torch.tools.studies.processes import Processes
from arcade_torch.tools.studies.runner import DiskFullError, make_engine, planned, study
from arcade_torch.tools.studies.shards import part_of
from arcade_torch.tools.switches import Unless
from arcade_torch.tools.text import counted, say


class Resumable(Command):
    """What ``study`` and ``demo`` share."""

    word: ClassVar[str]

    def resume_hint(self) -> str:
        """What an interruption left, and the command that goes on."""
        line = command_line([self.word, *self.argv])
        return f"finished runs are kept, the others go on from their checkpoints with: {line}"

    def report_workers(self, engine: Engine) -> int:
        """Processes that measure for the report: as many as trained, if those were of this
        machine.
        """
        if isinstance(engine, Processes):
            return engine.workers
        return 1 if isinstance(engine, Inline) else 0

    def carry_out(
        self,
        definition: Study,
        out: Path,
        engine: Engine,
        shard: str = "",
        report: bool = True,
        skip: Sequence[Part] = (),
    ) -> int:
        """Run a study, say how each run ended, and write the report; exit code 1 if a run
        failed.
        """
        argv = []
        for word, before in zip(self.argv, ("", *self.argv), strict=False):
            if not word.startswith("--shard") and before != "--shard":
                argv.append(word)
        command = command_line([self.word, *argv])
        try:
            result = study(definition, out, engine, command=command, shard=shard)
        except DiskFullError as error:
            say(f"stopped: {error}; {self.resume_hint()}")
            return 1
        say(
            f"{result.finished} of {len(result.rows)} runs finished; table: "
            f"{result.root / 'results.csv'}"
        )
        for name, reason in result.errors.items():
            say(f"failed: {name}: {reason}")
        if report and result.finished and (not shard or result.finished == len(result.rows)):
            try:
                write_page(result.root, skip=skip, workers=self.report_workers(engine))
            except Exception:
                again = command_line(["report", str(result.root)])
                print(
                    f"the runs are kept, their report failed; write it again with: {again}",
                    file=sys.stderr,
                )
                raise
        return 1 if result.errors else 0


@dataclass
class StudyCommand(Resumable):
    """Run a grid of trainings described by one TOML file; type the same again to go on after an
    interruption.

    The file names games, memories and seeds, and optionally observability, algorithms, preset,
    total_frames, baseline, sizes, question, subject, a table [settings] with fields of the config
    that train takes, and tables [memory_options.NAME]. Where it names no algorithms, the preset's
    is trained, as train does.

    Example: arcade-torch study examples/studies/small-short.toml --out runs/mine --workers 4
    """

    word = "study"
    file: tyro.conf.Positional[Path | None] = None  # The study.
    preset: Literal["demo", "paper-easy", "paper", "size-sweep"] | None = None
    """A ready-made study in the place of a file."""
    out: Path | None = None  # Folder of the study; runs/NAME by default.
    engine: Literal["auto", "inline", "processes", "ray"] = "auto"
    """Where the runs are carried out; auto takes processes where there is more than one core."""
    workers: int = 0  # Runs at once; 0 for one a core, or for what the Ray cluster has room for.
    ray: Annotated[RayOptions, tyro.conf.arg(name="")] = field(default_factory=RayOptions)
    shard: str = ""
    """3/10 carries out the third, thirteenth, ... of the runs, for the array jobs of a scheduler;
    all write into one folder.
    """
    dry_run: bool = False  # Only print every run with its frames, and the frames of all together.
    # The agent that the report is about and compares with every other; that of the file by default.
    subject: str = ""
    # Whether the laws that a memory has to keep are checked before models of yours are trained.
    check_memory: Unless = True
    # Whether an HTML report is written at the end; of shards, by the one that finishes the study.
    report: Unless = True

    def run(self) -> int:
        """Run the study; exit code 1 if a run failed."""
        if (self.file is None) == (self.preset is None):
            raise ValueError(
                f"give a TOML file, or --preset with one of {', '.join(STUDY_PRESETS)}; one of the "
                "two"
            )
        if self.preset is not None:
            definition = study_preset(self.preset)
        else:
            definition = Study.load(str(self.file))
        if self.subject:
            definition = replace(definition, subject=self.subject)
        warning = definition.overridden_preset()
        if warning:
            print(f"warning: {warning}", file=sys.stderr)
        plan = planned(definition, self.shard, self.file)
        if self.dry_run:
            total = 0
            for run, config in plan.items():
                frames = config.num_updates * config.learner.frames_per_update
                total += frames
                say(f"{run.name}  {frames:,} frames")
            print(f"{counted(len(plan), 'run')}, {total:,} frames in all", file=sys.stderr)
            return 0
        if self.check_memory:
            check_memories_of(definition)
        engine = make_engine(self.engine, self.workers, self.ray)
        out = self.out or Path("runs") / definition.name
        return self.carry_out(definition, out, engine, self.shard, self.report)


@dataclass
class Demo(Resumable):
    """Small study of what memory does: two games as MDP and POMDP, with a memory and without, three
    seeds each.

    Ends in one HTML page with learning curves, observability gap, memory bias, saliency,
    counterfactual recall and beliefs. About six minutes on two cores; type the same again to go
    on after an interruption. One game is a probe, solved with memory and only with it; the other is
    one of the ten, where half a minute of training only begins to show it.

    Example: arcade-torch demo --games BattleShipEasy --frames 700000 --seeds 2 --out runs/ships
    """

    word = "demo"
    games: tuple[str, ...] = ("SignpostEasy", "MineSweeperEasy")  # Games to play.
    frames: int = 37_000  # Environment steps of each run.
    seeds: int = 3  # Runs of each agent and twin.
    out: Path = Path("runs/demo")  # Folder of the study.
    workers: int = 0  # Runs at once; 0 for one a core.

    def run(self) -> int:
        """Run the study and write its report."""
        definition = demo_study(self.games, self.frames, self.seeds)
        return self.carry_out(definition, self.out, make_engine("auto", self.workers))


@dataclass
class Report(Command):
    """Write the HTML page of a study: one file, nothing loaded from elsewhere. Missing analyses are
    made first.

    Example: arcade-torch report runs/demo
    """

    study: tyro.conf.Positional[Path]  # Folder of the study.
    out: Path | None = None  # The page; report.html in that folder by default.
    # Score of a run that the headline is based on.
    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    skip: tuple[Part, ...] = ()
    """Parts to leave out: strips, densities, exchanged frames, what one noisy frame changes,
    returns of the random policy and oracles.
    """
    subject: str = ""
    """The agent that the page is about and compares with every other; that of the study by
    default.
    """
    workers: int = 0  # Processes that measure at once; 0 for one a core.
    shard: str = ""
    """3/10 takes the third tenth of the measures that the page needs and writes no page, for the
    array jobs of a scheduler.
    """

    def run(self) -> int:
        """Write the page, or measure a share of what it shows."""
        least = "at least 1, or 0 for one a core"
        require(self.workers >= 0, "workers", self.workers, least)
        if self.shard:
            part_of(self.shard)
        StudyFolder(self.study).load()  # refuses what is none before anything heavy is imported
        if self.shard:
            from arcade_torch.tools.reports import report_shard

            report_shard(self.study, self.shard, skip=self.skip, subject=self.subject)
            return 0
        write_page(
            self.study,
            self.out,
            metric=self.metric,
            skip=self.skip,
            subject=self.subject,
            workers=self.workers,
        )
        return 0


def check_memories_of(definition: Study) -> None:
    """Check the laws on every memory model of a study that is none of this package."""
    from arcade_torch.tools.memory_files import check_memory_of

    checked = set[str]()
    for run in definition.runs():
        if run.memory not in checked:
            checked.add(run.memory)
            check_memory_of(definition.config(run))


def write_page(study: Path, out: Path | None = None, **options: Any) -> None:
    """Write the report of a study, and say where it is."""
    from arcade_torch.tools.progress import Bars
    from arcade_torch.tools.reports import report

    check_writable(study / "report.html" if out is None else out)
    with Bars() as bars:
        say(f"report: {report(study, out, progress=bars.update, **options).resolve()}")
