"""What memory holds, for the page: recall density and state contamination of some cells of a study."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.analysis.checkpoints import contamination_of_run, density_of_run
from arcade_torch.tools.analysis.recall_density import RecallDensity
from arcade_torch.tools.reports.charts import SMALL, Line, category_chart
from arcade_torch.tools.reports.chosen import Cell
from arcade_torch.tools.reports.sections import TWIN_NAMES, Panel

BINS = 8
"""Parts of an episode, or as many as the shortest episode of a task has frames."""

DENSITY: Mapping[str, Any] = {"episodes": 16, "cap": 96}
"""Options of `recall_density` for the page; a figure for a paper takes 100 whole episodes."""

NOISE: Mapping[str, Any] = {"sigmas": (0.3,), "delays": (0, 1, 2, 5, 10, 20), "starts": 32, "cap": 96}
"""Options of `contamination` for the page."""

Progress = Callable[[str, int, int], None]


@dataclass
class MemorySection:
    """Charts, rows of the table, and what could not be shown."""

    panels: list[Panel] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def recall_section(cells: Sequence[Cell], colour: Mapping[str, str], progress: Progress | None = None) -> MemorySection:
    """Recall density of every cell, a chart a task.

    Args:
        cells: whom to look into; numbers are kept in the run folders.
        colour: colour class of every agent.
        progress: called with (what, done, total).
    """
    made, tasks = MemorySection(), dict[tuple[str, str], list[tuple[Cell, list[RecallDensity]]]]()
    for cell in cells:
        tell = partial(progress, f"recall density, {cell.agent} on {cell.game}") if progress else None
        found = [density_of_run(path, DENSITY, None, tell)[1] for path in cell.runs]
        if found := [density for density in found if density.shares]:
            tasks.setdefault((cell.game, cell.twin), []).append((cell, found))
        else:
            made.notes.append(f"{cell.agent} on {cell.game} {TWIN_NAMES[cell.twin]}: no episode of three frames")
    for (game, twin), agents in tasks.items():
        shortest = min(int(density.lengths.min()) for _, found in agents for density in found)
        bins = min(BINS, shortest)
        lines = [_line(cell, np.array([one.mass(bins) for one in found]), colour) for cell, found in agents]
        names = ["oldest", *[""] * (bins - 2), "latest"]
        _add_panel(made, game, twin, lines, names, "time in the episode", 1 / bins)
        made.rows += [_density_row(cell, found) for cell, found in agents]
    return made


def _density_row(cell: Cell, found: Sequence[RecallDensity]) -> dict[str, Any]:
    shares = [share for density in found for share in density.shares]
    return _row(cell, len(found)) | {
        "episodes": len(shares),
        "length": float(np.mean([share.size for share in shares])),
        "last": float(np.mean([share[-1] for share in shares])),
        "first": float(np.mean([share[0] for share in shares])),
        "older": float(np.mean([density.mass(2)[0] for density in found])),
    }


def contamination_section(
    cells: Sequence[Cell], colour: Mapping[str, str], progress: Progress | None = None
) -> MemorySection:
    """Share of decisions that one noisy frame changes, by delay; a chart a task.

    Args:
        cells: as for `recall_section`.
        colour: as for `recall_section`.
        progress: as for `recall_section`.
    """
    made, lines = MemorySection(), dict[tuple[str, str], list[Line]]()
    delays = [int(delay) for delay in NOISE["delays"]]
    for cell in cells:
        tell = partial(progress, f"contamination, {cell.agent} on {cell.game}") if progress else None
        try:
            found = [contamination_of_run(path, NOISE, progress=tell)[1] for path in cell.runs]
        except ValueError as error:  # episodes too short for a start point
            made.notes.append(f"{cell.agent} on {cell.game} {TWIN_NAMES[cell.twin]}: {error}")
            continue
        flips = np.array([item.mean("flip")[0] for item in found])
        change = over_seeds(np.array([item.mean("change")[0] for item in found]))[0]
        lines.setdefault((cell.game, cell.twin), []).append(_line(cell, flips, colour))
        later = [item.flip[:, 0, 1:] for item in found]
        made.rows.append(
            _row(cell, len(found))
            | {
                "points": sum(len(item.points) for item in found),
                "at_once": _mean(flips[:, 0]),
                "one": _mean(flips[:, 1]),
                "later": _mean(np.concatenate([part.ravel() for part in later])),
                "change": float(change[1]),
            }
        )
    names, axis = [str(delay) for delay in delays], "steps from the noisy frame to the decision"
    for (game, twin), here in lines.items():
        _add_panel(made, game, twin, here, names, axis, None)
    return made


def _row(cell: Cell, seeds: int) -> dict[str, Any]:
    return {"agent": cell.agent, "game": cell.game, "twin": TWIN_NAMES[cell.twin], "seeds": seeds}


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _line(cell: Cell, values: Array, colour: Mapping[str, str]) -> Line:
    mean, low, high = over_seeds(values)
    return Line(cell.agent, colour[cell.agent], np.arange(mean.size, dtype=np.float64), mean, low, high, values)


def _add_panel(
    made: MemorySection,
    game: str,
    twin: str,
    lines: Sequence[Line],
    names: Sequence[str],
    axis: str,
    level: float | None,
) -> None:
    top = max(float(np.nanmax(np.concatenate([line.y, line.high, [0.1]]))) for line in lines)
    chart = category_chart(f"{game}, {TWIN_NAMES[twin]}", lines, names, axis, (0.0, top), level, SMALL)
    made.panels.append(Panel(chart, "", f"{game}-{twin}"))
