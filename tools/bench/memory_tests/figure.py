"""The tests of memory as a picture: a row a model, a column a test and size."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.bench.memory_tests.table import Cell, Row, cells, columns
from arcade_torch.tools.figures import style

__all__ = ["heat_map", "write"]

COLOURS = "YlGnBu"
CHANCE_GREY = "#e8e8e8"
BELOW = -1.0
"""Score of a cell at chance in the picture; cells that were not measured are white."""
DARK = 0.55
"""Score from which numbers are written in white."""


def heat_map(rows: Sequence[Row], models: Sequence[str]) -> Any:
    """A figure of matplotlib. Colour: share of what a guess misses that is right; grey: chance.
    Numbers: per cent of right answers, bold where solved.
    """
    table = cells(rows)
    pairs = columns(rows)
    size = (2.6 + 0.47 * len(pairs), 1.9 + 0.36 * len(models))
    figure, axes = style.panels(1, 1, size)
    axis = axes[0, 0]
    scores = np.full((len(models), len(pairs)), np.nan)
    for place, (test, level) in enumerate(pairs):
        for line, model in enumerate(models):
            cell = table.get((model, test.name, level))
            if cell is None:
                continue
            scores[line, place] = BELOW if cell.verdict == "chance" else cell.score
            _write_number(axis, place, line, cell)
    image = axis.imshow(scores, cmap=COLOURS, vmin=0, vmax=1, aspect="auto")
    image.set_cmap(image.get_cmap().with_extremes(under=CHANCE_GREY))
    bar = figure.colorbar(image, ax=axis, ticks=[0, 0.5, 1], fraction=0.02, pad=0.01, extend="min")
    bar.ax.set_yticklabels(["chance", "half", "all"])
    axis.grid(visible=False)
    axis.set_yticks(range(len(models)), models)
    _name_columns(axis, pairs)
    return figure


def _write_number(axis: Any, place: int, line: int, cell: Cell) -> None:
    """Per cent of right answers in the middle of a cell."""
    colour = "white" if cell.score > DARK else "black"
    axis.text(
        place,
        line,
        f"{100 * cell.accuracy:.0f}",
        ha="center",
        va="center",
        fontsize="small",
        color="#777777" if cell.verdict == "chance" else colour,
        weight="bold" if cell.verdict == "solved" else "normal",
    )


def _name_columns(axis: Any, pairs: Sequence[tuple[Any, int]]) -> None:
    """Sizes below, names of tests above, a line between two tests."""
    labels = []
    names: dict[str, list[int]] = {}
    for place, (test, level) in enumerate(pairs):
        labels.append(f"{level}{'*' if level > max(test.trained) else ''}")
        names.setdefault(test.name, []).append(place)
    axis.set_xticks(range(len(pairs)), labels)
    axis.set_xlabel("size of the test; * beyond every size that was learned")
    for name, places in names.items():
        middle = sum(places) / len(places)
        axis.text(middle, -0.65, name, ha="center", va="bottom", fontsize="small", rotation=25)
        axis.axvline(places[-1] + 0.5, color="white", linewidth=3)


def write(path: Path, rows: Sequence[Row], models: Sequence[str]) -> Path:
    """Draw the rows of some models into a PNG file."""
    with style.drawing("light"):
        return write_atomic(path, style.png(heat_map(rows, models)))
