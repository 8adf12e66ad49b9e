"""The figures by name: what each shows, its options, who makes it."""

from dataclasses import fields
from importlib import import_module
from typing import NamedTuple

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import check_writable, check_writable_folder
from arcade_torch.tools.figures import (
    MARKDOWN,
    NUMBERS,
    PICTURES,
    CurveOptions,
    Made,
    Options,
    PaperOptions,
    Progress,
    TableOptions,
)
from arcade_torch.tools.measures import EpisodeOptions
from arcade_torch.tools.measures.beliefs import BeliefsOptions
from arcade_torch.tools.measures.contamination import ContaminationOptions
from arcade_torch.tools.measures.counterfactual import CounterfactualOptions
from arcade_torch.tools.measures.gap_bias import ScoreOptions, SweepOptions
from arcade_torch.tools.measures.recall_density import DensityOptions
from arcade_torch.tools.measures.saliency import SaliencyOptions

OF_FILES = (
    *PICTURES, *NUMBERS, ".jpg", ".jpeg", ".gif", ".webp", ".tif", ".tiff", ".eps", ".ps",
    MARKDOWN, ".txt", ".html", ".json", ".npz",
)  # fmt: skip
"""Endings that no folder has, in capitals either: somebody means a file."""


class Entry(NamedTuple):
    """A figure."""

    options: type[Options]
    maker: str  # MODULE.FUNCTION below `arcade_torch.tools`, of (options, progress) -> Made
    summary: str  # what it shows
    example: str
    analysis: bool = False  # whether ``analyze`` has it too
    several: bool = False  # whether it has several pictures


FIGURES = {
    "returns": Entry(
        ScoreOptions,
        "measures.gap_bias.figure.returns",
        "POMDP return, Gap and Bias of every agent, also without each game",
        "--runs runs/study --out figures",
        several=True,
    ),
    "gap-bias": Entry(
        ScoreOptions,
        "measures.gap_bias.figure.gap_bias",
        "observability gap and memory bias of every agent, with intervals",
        "runs/demo --metric train_max_ewm",
        analysis=True,
    ),
    "curves": Entry(
        CurveOptions,
        "figures.logs.curves",
        "training curves, one panel a task, one line an agent",
        "--runs runs/study",
    ),
    "saliency": Entry(
        SaliencyOptions,
        "measures.saliency.figure.rows",
        "which pixels of the past the last decision depends on, one row a run",
        "runs/one --show 10",
        analysis=True,
    ),
    "recall-density": Entry(
        DensityOptions,
        "measures.recall_density.figure.densities",
        "how decisions spread over the past of their episodes",
        "runs/one runs/two --bins 3 16 --out figures",
        analysis=True,
        several=True,
    ),
    "counterfactual": Entry(
        CounterfactualOptions,
        "measures.counterfactual.figure.by_lag",
        "which decisions change if a past frame, or the recurrent state, is another episode's",
        "runs/one runs/control --episodes 64 --donors 4",
        analysis=True,
        several=True,
    ),
    "beliefs": Entry(
        BeliefsOptions,
        "measures.beliefs.figure.by_fact",
        "which hidden facts can be read off the recurrent state, and which off a frame",
        "runs/one runs/control --episodes 64",
        analysis=True,
        several=True,
    ),
    "contamination": Entry(
        ContaminationOptions,
        "measures.contamination.figure.by_delay",
        "what one noisy or shuffled past frame does to later decisions",
        "runs/one --sigmas 0.1 1.0 --delays 0 1 5 20 --starts 100",
        analysis=True,
        several=True,
    ),
    "size-sweep": Entry(
        SweepOptions,
        "measures.gap_bias.figure.size_sweep",
        "Gap and Bias by depth and width of the memory, beside the memory-free agent",
        "--runs runs/size-sweep",
    ),
    "throughput": Entry(
        Options,
        "figures.logs.throughput",
        "frames per second by number of envs, from the file of bench envs",
        "--runs runs/bench.csv",
    ),
    "human": Entry(
        PaperOptions,
        "measures.gap_bias.figure.human",
        "returns of people beside those of the memory-free agent",
        "--out figures",
    ),
    "hyperparameters": Entry(
        TableOptions,
        "figures.logs.hyperparameters",
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
    if isinstance(options, EpisodeOptions) and not options.runs:
        raise ValueError("name at least one run folder")
    if entry.several and options.out is not None and options.out.suffix in (*PICTURES, *NUMBERS):
        raise ValueError(f"this figure has several files: give a folder, not --out {options.out}")
    if isinstance(options, PaperOptions) and options.paper:
        _check_paper(options)
    _check_out(options)
    module, _, maker = entry.maker.rpartition(".")
    make = getattr(import_module(f"arcade_torch.tools.{module}"), maker)
    with drawing(options.style):
        result: Made = make(options, progress)
        for picture in result.pictures:
            result.files += save(options, picture)
    missing = "".join(sorted({letter for picture in result.pictures for letter in picture.missing}))
    if missing:
        result.notes.append(
            f"drawn as boxes, no installed font has them: {missing}; install one that does, or "
            "take --out NAME.svg"
        )
    return result


def _check_paper(options: PaperOptions) -> None:
    """Refuse what would not be looked at beside ``--paper``."""
    if options.runs:
        raise ValueError(
            "--paper draws published numbers in the place of runs, and these are named: "
            f"{', '.join(map(str, options.runs))}; leave out one of the two"
        )
    of_all = {option.name for option in fields(PaperOptions)}
    for option in fields(options):
        value = getattr(options, option.name)
        if option.name not in of_all and value != option.default:
            raise ValueError(
                "--paper draws published numbers as they are: leave out "
                f"--{option.name.replace('_', '-')}, got {value}"
            )


def _check_out(options: Options) -> None:
    """Refuse files that cannot be written, before the work for them begins."""
    base, endings = options.path("figure")
    if len(endings) == 1:
        check_writable(base.with_name(base.name + endings[0]))
        return
    is_folder = base.parent.suffix.lower() not in OF_FILES
    allowed = f"a folder, or a file that ends in {', '.join(options.kinds)}"
    require(is_folder, "--out", str(base.parent), allowed)
    check_writable_folder(base.parent)
