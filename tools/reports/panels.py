"""The pictures of the page: every one is a figure of `arcade_torch.tools.figures`, as SVG or PNG."""

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, Pooled, over_seeds
from arcade_torch.tools.analysis.checkpoints import by_task, measure_run
from arcade_torch.tools.analysis.contamination import Contamination
from arcade_torch.tools.analysis.contamination import contamination as noise
from arcade_torch.tools.analysis.curves import curves_of_runs
from arcade_torch.tools.analysis.gap_bias import GapBias
from arcade_torch.tools.analysis.pixel_saliency import episode_saliency
from arcade_torch.tools.analysis.recall_density import RecallDensity
from arcade_torch.tools.analysis.recall_density import recall_density as density_of
from arcade_torch.tools.figures import contamination, curves, gap_bias, recall_density, saliency
from arcade_torch.tools.figures.style import TWIN_NAMES, agent_colours, drawing, png, svg
from arcade_torch.tools.reports.selection import Cell
from arcade_torch.tools.runs import Runs

FULL, SMALL = (4.9, 3.0), (3.3, 2.3)
"""Sizes in inches; small ones for many tasks."""

BINS = 8
"""Parts of an episode, or as many as the shortest episode of a task has frames."""

DENSITY: Mapping[str, Any] = {"episodes": 16, "cap": 96}
"""Options of `recall_density` for the page; a figure for a paper takes 100 whole episodes."""

NOISE: Mapping[str, Any] = {"sigmas": (0.3,), "delays": (0, 1, 2, 5, 10, 20), "starts": 32, "cap": 96}
"""Options of `contamination` for the page."""

SHOW, TRIES = 8, 10
"""Frames of a saliency strip; episodes that are tried until one has as many."""

LEVEL_NAMES = {"random": "random", "state": "oracle", "frames": "frames oracle"}
Levels = Mapping[str, Mapping[str, float]]
"""Game -> player -> mean return."""
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Panel:
    """A picture, what stands below it, and the task it is of, as ``GAME-TWIN`` (empty where there are several)."""

    picture: str
    caption: str = ""
    task: str = ""


@dataclass
class Section:
    """Pictures, rows of the table, and what could not be shown."""

    panels: list[Panel] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def picture(name: str, size: tuple[float, float], plot: Callable[[Any], object]) -> str:
    """Draw on one axis; returns an SVG element."""
    with drawing("light") as plt:
        figure, axis = plt.subplots(figsize=size, layout="constrained")
        plot(axis)
        return svg(figure, name)


def curve_panels(runs: Runs, kind: str, levels: Levels, agents: Sequence[str], small: bool) -> list[Panel]:
    """One picture a task; the twins of a game share their y axis."""
    groups = {key: [run.folder for run in group] for key, group in runs.groups().items()}
    every, panels = curves_of_runs(groups, kind), []
    for game, twin in dict.fromkeys((curve.game, curve.observability) for curve in every):
        here = [curve for curve in every if (curve.game, curve.observability) == (game, twin)]
        seen = np.concatenate([curve.seeds.ravel() for curve in every if curve.game == game])
        means = levels.get(game, {})
        low, high = min([seen.min(), *means.values()]), max([seen.max(), *means.values()])
        margin = 0.07 * (high - low) or 0.5
        shown = _joined({LEVEL_NAMES[k]: v for k, v in means.items() if (k, twin) != ("frames", "full")}, 2 * margin)
        title = f"{game}, {TWIN_NAMES[twin]}"

        def plot(axis: Any, here: Any = here, shown: Any = shown, title: str = title, ends: Any = (low, high)) -> None:
            curves.plot(here, axis, agents, shown)
            axis.set_ylim(ends[0] - margin, ends[1] + margin)  # noqa: B023  (drawn at once)
            axis.set_title(title)

        counts = sorted({len(curve.seeds) for curve in here})
        seeds = " or ".join(map(str, counts)) + (" seed" if counts == [1] else " seeds")
        caption = f"mean of {seeds}" + ("; band: interval over seeds" if counts != [1] else "")
        drawn = picture(f"{kind} {title}", SMALL if small else FULL, plot)
        panels.append(Panel(drawn, "" if small else caption, f"{game}-{twin}"))
    return panels


def _joined(levels: Mapping[str, float], apart: float) -> dict[str, float]:
    """Reference lines that lie on one another share a label."""
    found: dict[str, float] = {}
    for name, value in levels.items():
        near = next((other for other, at in found.items() if abs(at - value) < apart), None)
        found |= {f"{near}, {name}": found.pop(near)} if near is not None else {name: value}
    return found


def score_panels(table: GapBias) -> list[Panel]:
    """Normalised returns on both twins, Gap and Bias."""
    return [Panel(picture(name, FULL, partial(gap_bias.plot_bars, table.rows, name=name))) for name in gap_bias.PANELS]


@dataclass(frozen=True)
class Strip:
    """Frames under heat: whose they are, the picture, length of the episode, value drawn brightest, last share (%)."""

    cell: Cell
    source: str
    frames: int
    peak: float
    last_share: float


def saliency_strips(cells: Sequence[Cell], progress: Progress | None) -> list[Strip]:
    """One strip for each cell, from its first finished seed."""
    strips = []
    for done, cell in enumerate(cells, start=1):
        _, found = measure_run(cell.runs[0], episode_saliency, {"show": SHOW, "tries": TRIES})
        frames, shares = found.frames, 100 * found.shares()
        count = min(SHOW, len(frames))
        with drawing("light") as plt:
            figure = plt.figure(figsize=(4.8, 1.4 * -(-count // 4)), layout="constrained")
            axes = figure.subplots(-(-count // 4), 4, squeeze=False).flatten()
            for axis in axes[count:]:
                axis.set_axis_off()
            peak = saliency.plot(frames, found.maps, axes[:count], below=shares)
            source = "data:image/png;base64," + b64encode(png(figure)).decode("ascii")
        strips.append(Strip(cell, source, len(frames), peak, float(shares[-1])))
        if progress is not None:
            progress("saliency", done, len(cells))
    return strips


def recall_section(cells: Sequence[Cell], agents: Sequence[str], progress: Progress | None) -> Section:
    """Recall density of every cell, a picture a task; numbers are kept in the run folders."""
    made, tasks = Section(), dict[tuple[str, str], dict[str, list[RecallDensity]]]()
    for cell in cells:
        tell = partial(progress, f"recall density, {cell.agent} on {cell.game}") if progress else None
        every = [measure_run(path, density_of, DENSITY, None, tell)[1] for path in cell.runs]
        if found := [density for density in every if density.shares]:
            tasks.setdefault((cell.game, cell.twin), {})[cell.agent] = found
            shares = [share for density in found for share in density.shares]
            row = {"episodes": len(shares), "length": float(np.mean([share.size for share in shares]))}
            row |= {"last": float(np.mean([s[-1] for s in shares])), "first": float(np.mean([s[0] for s in shares]))}
            row |= {"older": float(np.mean([density.mass(2)[0] for density in found]))}
            made.rows.append(_row(cell, len(found)) | row)
        else:
            made.notes.append(f"{cell.agent} on {cell.game} {TWIN_NAMES[cell.twin]}: no episode of three frames")
    for (game, twin), here in tasks.items():
        bins = min(BINS, *(int(density.lengths.min()) for found in here.values() for density in found))
        series = {}
        for agent, found in here.items():
            series[agent] = (Pooled.of([density.mass(bins) for density in found]), agent_colours(agents)[agent])
        title = f"{game}, {TWIN_NAMES[twin]}"

        def plot(axis: Any, series: Any = series, bins: int = bins, title: str = title) -> None:
            recall_density.plot(series, axis, bins)
            axis.set(title=title, xlabel="time in the episode (1: the decision)")

        made.panels.append(Panel(picture(f"recall {title}", SMALL, plot), "", f"{game}-{twin}"))
    return made


def contamination_section(cells: Sequence[Cell], agents: Sequence[str], progress: Progress | None) -> Section:
    """Share of decisions that one noisy frame changes, by delay; a picture a task."""
    made, tasks = Section(), dict[tuple[str, str], dict[str, contamination.Measures]]()
    for cell in cells:
        tell = partial(progress, f"contamination, {cell.agent} on {cell.game}") if progress else None
        try:
            measured = [measure_run(path, noise, NOISE, None, tell) for path in cell.runs]
        except ValueError as error:  # episodes too short for a start point
            made.notes.append(f"{cell.agent} on {cell.game} {TWIN_NAMES[cell.twin]}: {error}")
            continue
        (pooled,) = contamination.pool(by_task(measured)).values()
        tasks.setdefault((cell.game, cell.twin), {})[cell.agent] = pooled
        made.rows.append(_row(cell, len(measured)) | _noise_row([found for _, found in measured]))
    for (game, twin), here in tasks.items():
        delays = NOISE["delays"][: contamination.reached(here.values())]
        title = f"{game}, {TWIN_NAMES[twin]}"

        def plot(axis: Any, here: Any = here, delays: Any = delays, title: str = title) -> None:
            contamination.plot(here, axis, "flip", 0, delays, agent_colours(agents))
            top = max(axis.get_ylim()[1], contamination.LEAST_SCALE)
            axis.set(title=title, xlabel="steps after the noisy frame", ylim=(-0.05 * top, top))

        made.panels.append(Panel(picture(f"noise {title}", SMALL, plot), "", f"{game}-{twin}"))
    return made


def _noise_row(found: Sequence[Contamination]) -> dict[str, Any]:
    flips = np.array([item.mean("flip")[0] for item in found])
    change = over_seeds(np.array([item.mean("change")[0] for item in found]))[0]
    later = np.concatenate([item.flip[:, 0, 1:].ravel() for item in found])
    row = {"points": sum(len(item.points) for item in found), "change": float(change[1])}
    return row | {"at_once": _mean(flips[:, 0]), "one": _mean(flips[:, 1]), "later": _mean(later)}


def _row(cell: Cell, seeds: int) -> dict[str, Any]:
    return {"agent": cell.agent, "game": cell.game, "twin": TWIN_NAMES[cell.twin], "seeds": seeds}


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")
