"""What all figures share: their options, and what a figure gives. Those of a measure stand in its
folder below `arcade_torch.tools.measures`, their table in `catalogue`, their look in `style`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from arcade_torch.tools.files import Table

Progress = Callable[[str, int, int], None]
# of a report; what may be left out
Part = Literal[
    "saliency", "recall", "counterfactual", "beliefs", "contamination", "references"
]  # fmt: skip
PICTURES = (".pdf", ".png", ".svg")
NUMBERS = (".csv",)
MARKDOWN = ".md"

# The comment behind an option is its help.


@dataclass
class Options:
    """Options that every figure has."""

    runs: tuple[Path, ...] = ()
    """Studies, run folders, or folders that hold such; or a table, where a figure reads one."""
    out: Path | None = None
    """Folder for pictures and numbers; or a file, .png, .pdf or .svg for one picture, .csv for the
    numbers alone.
    """
    style: Literal["light", "print"] = "light"  # For a screen, or for a page.
    csv: bool = False  # Print the numbers as CSV in the place of tables, and nothing else.
    kinds: ClassVar[tuple[str, ...]] = (*PICTURES, *NUMBERS)  # of the files that ``out`` can be

    def path(self, name: str) -> tuple[Path, tuple[str, ...]]:
        """Path without ending, and the endings, of the files of a figure."""
        out = self.out or Path("figures")
        if out.suffix in self.kinds:
            return out.with_suffix(""), (out.suffix,)
        return out / name, (".pdf", ".png", *NUMBERS)


@dataclass
class PaperOptions(Options):
    """Options of figures that the paper's own numbers can be drawn in."""

    paper: bool = False  # The paper's published numbers in the place of runs.


@dataclass
class TableOptions(PaperOptions):
    """Options of figures that are a table, which Markdown has too."""

    kinds: ClassVar[tuple[str, ...]] = (*PICTURES, *NUMBERS, MARKDOWN)


@dataclass
class CurveOptions(Options):
    """Options of figures over the seeds of runs."""

    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run: final greedy evaluation, or the paper's best smoothed training return
    (exploration included).
    """
    confidence: float = 0.95  # Of the intervals.


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
    missing: str = ""  # letters that no font has, known when it was saved


@dataclass
class Made:
    """What became of it: pictures, lines for the user, tables to print, and the files that were
    written.
    """

    pictures: list[Picture] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
