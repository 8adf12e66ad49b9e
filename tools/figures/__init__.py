"""The figures by name: what each shows, its options, who makes it. Needs neither numpy nor torch
nor matplotlib.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

from arcade_torch.agents.config import require
from arcade_torch.tools.files import Table

Progress = Callable[[str, int, int], None]
# of a report; what may be left out
Part = Literal["saliency", "recall", "contamination", "references"]
PICTURES = (".pdf", ".png", ".svg")
NUMBERS = (".csv",)

# The comment behind an option is its help.


@dataclass
class Options:
    """Options that every figure has."""

    runs: tuple[Path, ...] = ()  # Studies, run folders, or folders that hold such.
    out: Path | None = None
    """Folder for pictures and numbers; or a file, .png, .pdf or .svg for one picture, .csv for the
    numbers alone.
    """
    style: Literal["light", "print"] = "light"  # For a screen, or for a page.
    csv: bool = False  # Print the numbers as CSV in the place of tables, and nothing else.

    def path(self, name: str) -> tuple[Path, tuple[str, ...]]:
        """Path without ending, and the endings, of the files of a figure."""
        out = self.out or Path("figures")
        if out.suffix in (*PICTURES, *NUMBERS):
            return out.with_suffix(""), (out.suffix,)
        return out / name, (".pdf", ".png", *NUMBERS)


@dataclass
class PaperOptions(Options):
    """Options of figures that the paper's own numbers can be drawn in."""

    paper: bool = False  # The paper's published numbers in the place of runs.


@dataclass
class CurveOptions(Options):
    """Options of figures over the seeds of runs."""

    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run: final greedy evaluation, or the paper's best smoothed training return
    (exploration included).
    """
    confidence: float = 0.95  # Of the intervals.


@dataclass
class SweepOptions(CurveOptions):
    """Options of figures of Gap and Bias."""

    baseline: str = "mlp"  # The memory-free agent.
    draws: int = 10_000  # Bootstrap draws.


@dataclass
class ScoreOptions(SweepOptions, PaperOptions):
    """Options of figures that are made from scores; ``runs`` may be CSV files too."""


@dataclass
class CheckpointOptions(Options):
    """Options of figures that look into checkpoints."""

    # Another twin than the agents were trained on.
    observability: Literal["full", "partial"] | None = None
    target: Literal["auto", "q", "logits", "probs", "value"] = "auto"
    """The outputs that are looked at; Q-values, or a policy's probabilities, by default."""
    seed: int = 0  # Of the episodes, and of what is drawn in them.


@dataclass
class SaliencyOptions(CheckpointOptions):
    """Options of the saliency maps."""

    max_steps: int = 30  # Longest episode; the paper's figures have 30.
    show: int = 8  # How many of the last frames are drawn.
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    norm: Literal["l2sq", "l2", "l1"] = "l2sq"  # Norm over colour channels.


@dataclass
class DensityOptions(CheckpointOptions):
    """Options of recall density."""

    bins: tuple[int, ...] = (3, 16)  # Numbers of bins, a figure each; up to 6 as stacked bars.
    episodes: int = 100  # Greedy trajectories of each checkpoint.
    # The decision: the one that ended the episode, or a random one.
    end: Literal["last", "random"] = "last"
    max_frames: int = 512  # Longest trajectory; a longer episode gives a window with a random end.
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    norm: Literal["l1", "l2sq", "l2"] = "l1"  # Norm of a gradient over a frame.
    confidence: float = 0.95  # Of the bands.


@dataclass
class ContaminationOptions(CheckpointOptions):
    """Options of state contamination."""

    # Standard deviations of the noise; 1 is the range of a pixel.
    sigmas: tuple[float, ...] = (0.1, 0.3, 1.0)
    delays: tuple[int, ...] = (0, 1, 2, 5, 10, 20, 50, 100)
    """Steps from the noisy frame to the decision; 0 is the ceiling."""
    # Of the example: steps from the start, or from the shuffled frames, to the decision.
    horizon: int = 10
    starts: int = 200  # Start points of each checkpoint, at most four an episode.
    shuffle: bool = False  # Permute frames 2 to 10 in place of adding noise.
    clip: bool = False  # Keep noisy pixels in their range.
    # Let the replay choose the previous actions itself, as the published code does.
    feedback: bool = False
    confidence: float = 0.95  # Of the bars.


@dataclass
class Picture:
    """A figure of matplotlib: the name of its files, what stands under it, its numbers for a CSV
    and an npz file.
    """

    name: str
    figure: Any
    note: str = ""
    rows: Sequence[Mapping[str, Any]] = ()
    arrays: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Made:
    """What became of it: pictures, lines for the user, tables to print, and the files that were
    written.
    """

    pictures: list[Picture] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


class Entry(NamedTuple):
    """A figure."""

    options: type[Options]
    maker: str  # MODULE.FUNCTION of (options, progress) -> Made
    summary: str  # what it shows
    example: str
    analysis: bool = False  # whether ``analyze`` has it too
    several: bool = False  # whether it has several pictures


FIGURES = {
    "returns": Entry(
        ScoreOptions,
        "gap_bias.returns",
        "POMDP return, Gap and Bias of every agent, also without each game",
        "--runs runs/study --out figures",
        several=True,
    ),
    "gap-bias": Entry(
        ScoreOptions,
        "gap_bias.gap_bias",
        "observability gap and memory bias of every agent, with intervals",
        "runs/demo --metric train_max_ewm",
        True,
    ),
    "curves": Entry(
        CurveOptions,
        "logs.curves",
        "training curves, one panel a task, one line an agent",
        "--runs runs/study",
    ),
    "saliency": Entry(
        SaliencyOptions,
        "saliency.rows",
        "which pixels of the past the last decision depends on, one row a run",
        "runs/one --show 10",
        True,
    ),
    "recall-density": Entry(
        DensityOptions,
        "recall_density.densities",
        "how decisions spread over the past of their episodes",
        "runs/one runs/two --bins 3 16 --out figures",
        True,
        True,
    ),
    "contamination": Entry(
        ContaminationOptions,
        "contamination.by_delay",
        "what one noisy or shuffled past frame does to later decisions",
        "runs/one --sigmas 0.1 1.0 --delays 0 1 5 20 --starts 100",
        True,
        True,
    ),
    "size-sweep": Entry(
        SweepOptions,
        "gap_bias.size_sweep",
        "Gap and Bias by depth and width of the memory",
        "--runs runs/size-sweep",
    ),
    "throughput": Entry(
        Options,
        "logs.throughput",
        "frames per second by number of envs, from the file of bench envs",
        "--runs runs/bench.csv",
    ),
    "human": Entry(
        PaperOptions,
        "gap_bias.human",
        "returns of people beside those of the memory-free agent",
        "--out figures",
    ),
    "hyperparameters": Entry(
        PaperOptions,
        "logs.hyperparameters",
        "table of the settings of runs, or of the paper's preset",
        "--paper",
    ),
}


def make_figure(name: str, options: Options, progress: Progress | None = None) -> Made:
    """Make a figure, and save it with its numbers.

    Args:
        name: one of `FIGURES`.
        options: of the type that stands there.
        progress: called with (what, done, of how many).

    Raises:
        ValueError: an option is out of range, or there is nothing to draw.
    """
    from arcade_torch.tools.figures.style import drawing, save

    confidence = getattr(options, "confidence", 0.95)
    entry = FIGURES[name]
    require(0 < confidence < 1, "confidence", confidence, "between 0 and 1")
    if isinstance(options, CheckpointOptions) and not options.runs:
        raise ValueError("name at least one run folder")
    if entry.several and options.out is not None and options.out.suffix in (*PICTURES, *NUMBERS):
        raise ValueError(f"this figure has several files: give a folder, not --out {options.out}")
    module, maker = entry.maker.split(".")
    make = getattr(import_module(f"arcade_torch.tools.figures.{module}"), maker)
    with drawing(options.style):
        result: Made = make(options, progress)
        for picture in result.pictures:
            result.files += save(options, picture)
    return result
