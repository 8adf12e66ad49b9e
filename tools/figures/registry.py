"""The figures by name, and what all of them have in common."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

from arcade_torch.tools.tables import Table

Progress = Callable[[str, int, int], None]
PICTURES, NUMBERS = (".pdf", ".png", ".svg"), (".csv",)
Twin = Literal["full", "partial"]


@dataclass
class Options:
    """Options that every figure has."""

    runs: tuple[Path, ...] = ()
    """Studies, run folders, or folders that hold such."""
    out: Path | None = None
    """Folder for pictures and numbers; or a file, .png, .pdf or .svg for one picture, .csv for the numbers alone."""
    style: Literal["light", "print"] = "light"
    """For a screen, or for a page."""
    csv: bool = False
    """Print the numbers as CSV in the place of tables, and nothing else."""

    def path(self, name: str) -> tuple[Path, tuple[str, ...]]:
        """Path without ending, and the endings, of the files of a figure."""
        out = self.out or Path("figures")
        if out.suffix in (*PICTURES, *NUMBERS):
            return out.with_suffix(""), (out.suffix,)
        return out / name, (".pdf", ".png", *NUMBERS)

    def check_folder(self) -> None:
        """Refuse a single file for several pictures."""
        if self.out is not None and self.out.suffix in (*PICTURES, *NUMBERS):
            raise ValueError(f"this figure has several files: give a folder, not --out {self.out}")

    def checkpoints(self) -> None:
        """Refuse what no checkpoint can be measured with."""
        if not self.runs:
            raise ValueError("name at least one run folder")


@dataclass
class ScoreOptions(Options):
    """Options of figures that are made from scores; ``runs`` may be CSV files too."""

    paper: bool = False
    """The paper's published returns in the place of runs."""
    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run: final greedy evaluation, or the paper's best smoothed training return."""
    baseline: str = "mlp"
    """The memory-free agent."""
    confidence: float = 0.95
    """Of the intervals."""
    draws: int = 10_000
    """Bootstrap draws."""


@dataclass
class Made:
    """What became of it.

    Attributes:
        files: that were written.
        notes: lines for the user.
        tables: to print.
        rows: the numbers of the figure.
    """

    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    rows: Sequence[dict[str, Any]] = ()


class Entry(NamedTuple):
    """A figure: what it shows, and an example. Its module has ``Options`` and ``make(options, progress) -> Made``."""

    summary: str
    example: str
    analysis: bool = False


FIGURES = {
    "returns": Entry(
        "POMDP return, Gap and Bias of every agent, also without each game", "--runs runs/study --out figures"
    ),
    "gap-bias": Entry(
        "observability gap and memory bias of every agent, with intervals", "runs/demo --metric train_max_ewm", True
    ),
    "curves": Entry("training curves, one panel a task, one line an agent", "--runs runs/study"),
    "saliency": Entry(
        "which pixels of the past the last decision depends on, one row a run", "runs/one --show 10", True
    ),
    "recall-density": Entry(
        "how decisions spread over the past of their episodes", "runs/one runs/two --bins 3 16 --out figures", True
    ),
    "contamination": Entry(
        "what one noisy or shuffled past frame does to later decisions",
        "runs/one --sigmas 0.1 1.0 --delays 0 1 5 20 --starts 100",
        True,
    ),
    "size-sweep": Entry("Gap and Bias by depth and width of the memory", "--runs runs/size-sweep"),
    "throughput": Entry("frames per second by number of envs, from the file of bench envs", "--runs runs/bench.csv"),
    "human": Entry("returns of people beside those of the memory-free agent", "--out figures"),
    "hyperparameters": Entry("table of the settings of runs, or of the paper's preset", "--paper"),
}


def module_of(name: str) -> Any:
    """The module of a figure."""
    return import_module(f"arcade_torch.tools.figures.{name.replace('-', '_')}")


def make_figure(name: str, progress: Progress | None = None, **options: Any) -> Made:
    """Make a figure."""
    module = module_of(name)
    made: Made = module.make(module.Options(**options), progress)
    return made


def tell(progress: Progress | None, name: str) -> Callable[[int, int], None] | None:
    """Progress of one part."""
    return None if progress is None else partial(progress, name)
