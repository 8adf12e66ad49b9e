"""The figures by name."""

import difflib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Request:
    """What a figure is asked for.

    Attributes:
        runs: folders with runs; for throughput the file of ``arcade-torch bench envs``.
        out: folder for the files.
        style: ``light`` or ``print``.
        paper: the paper's published numbers in place of runs.
        metric: score of a run.
        baseline: the memory-free agent.
        confidence: of intervals.
        episodes: trajectories of each checkpoint.
        bins: of recall densities.
        end: last decision of trajectories, ``last`` or ``random``.
        progress: called with (what, done, total).
    """

    runs: tuple[Path, ...] = ()
    out: Path = Path("figures")
    style: str = "light"
    paper: bool = False
    metric: str = "eval_final"
    baseline: str = "mlp"
    confidence: float = 0.95
    episodes: int = 100
    bins: tuple[int, ...] = (3, 16)
    end: str = "last"
    progress: Progress | None = None

    def tell(self, name: str) -> Callable[[int, int], None] | None:
        """Progress of one checkpoint."""
        if self.progress is None:
            return None
        return partial(self.progress, name)


@dataclass(frozen=True)
class Made:
    """What became of it: files, lines to tell the user, and a text to print."""

    files: list[Path]
    notes: list[str] = field(default_factory=list)
    text: str = ""


class Entry(NamedTuple):
    """A figure: its module (with a function ``make(request) -> Made``), what it shows, whether it has paper data."""

    module: str
    summary: str
    paper: bool = False


FIGURES = {
    "returns": Entry("returns", "POMDP return, Gap and Bias of every agent, also without each game", True),
    "gap-bias": Entry("gap_bias", "Gap against Bias, one point an agent", True),
    "curves": Entry("curves", "training curves, one panel a task, one line an agent"),
    "saliency": Entry("saliency", "which past pixels the last decision depends on, one row a run"),
    "recall-density": Entry("recall_density", "how decisions spread over the past: thirds as bars, 16 bins as curves"),
    "contamination": Entry("contamination", "what one noisy or shuffled past frame does to later decisions"),
    "size-sweep": Entry("size_sweep", "Gap and Bias by depth and width of the memory"),
    "throughput": Entry("throughput", "frames per second by number of envs, from the file of bench envs"),
    "human": Entry("human", "returns of people beside those of the memory-free agent", True),
    "hyperparameters": Entry("hyperparameters", "table of the settings of runs, or of the paper's preset", True),
}


def make_figure(name: str, request: Request) -> Made:
    """Make a figure.

    Args:
        name: one of `FIGURES`.
        request: from what, where to, how.

    Raises:
        ValueError: there is no such figure, it has no paper data, or the runs do not suffice.
    """
    if name not in FIGURES:
        near = difflib.get_close_matches(name, FIGURES, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(f"unknown figure {name!r}: {hint}figures are {', '.join(FIGURES)}")
    entry = FIGURES[name]
    if request.paper and not entry.paper:
        with_data = ", ".join(key for key, value in FIGURES.items() if value.paper)
        raise ValueError(f"the paper's numbers are there for {with_data}, not for {name}: give --runs")
    made: Made = import_module(f"arcade_torch.tools.figures.{entry.module}").make(request)
    return made
