"""Training curves: one panel a task, one line an agent, mean over seeds with a band."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.figures import style
from arcade_torch.tools.figures.registry import CurveOptions, Made, Picture, Progress
from arcade_torch.tools.runs import Run, find_runs

POINTS = 120  # of a training curve
AXIS = {"eval": "greedy return", "train": "training return, running mean"}


class Curve(NamedTuple):
    """One agent on one task: returns at some frames, of every seed [n_seeds, ...], their mean and its interval."""

    agent: str
    game: str
    observability: str
    frames: Array
    seeds: Array
    mean: Array
    low: Array
    high: Array


def curves(options: CurveOptions, progress: Progress | None) -> Made:
    """The figure ``curves``."""
    found = find_runs(options.runs)
    kind = "eval" if options.metric == "eval_final" else "train"
    every = curves_of_runs(found.groups(), kind, options.confidence)
    if not every:
        raise ValueError(f"no run below {options.runs[0]} has logged a {AXIS[kind]}: nothing to draw")
    tasks = list(dict.fromkeys((curve.game, curve.observability) for curve in every))
    agents = list(dict.fromkeys(curve.agent for curve in every))
    columns = min(4, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    figure, axes = style.panels(lines, columns, (max(5.5, 3.9 * columns), 0.8 + 3.0 * lines))
    for axis in axes.flat[len(tasks) :]:
        axis.set_axis_off()
    of_game: dict[str, Any] = {}
    for axis, (game, twin) in zip(axes.flat, tasks, strict=False):
        axis.sharey(of_game.setdefault(game, axis))  # twins are there to be compared
        plot([curve for curve in every if (curve.game, curve.observability) == (game, twin)], axis, agents)
        axis.set(title=f"{game}, {style.TWIN_NAMES.get(twin, twin)}", ylabel=AXIS[kind])
    handles = {handle.get_label(): handle for axis in axes.flat for handle in axis.get_lines()}
    shown = [handles[agent] for agent in agents if agent in handles]
    figure.legend(handles=shown, loc="outside upper center", ncols=min(8, len(shown)))
    note = style.seeds_note([len(curve.seeds) for curve in every], options.confidence, "bands")
    rows = []
    for c in every:
        what = {"agent": c.agent, "game": c.game, "observability": c.observability, "seeds": len(c.seeds)}
        rows += style.rows_of(**what, frames=c.frames.astype(np.int64), mean=c.mean, low=c.low, high=c.high)
    return Made([Picture("curves", figure, note, rows)], found.notes + found.single_seeds())


def plot(curves: Sequence[Curve], axis: Any, agents: Sequence[str], levels: Mapping[str, float] | None = None) -> None:
    """Draw the curves of one task."""
    longest = max(float(curve.frames[-1]) for curve in curves)
    unit, name = (1e6, "million frames") if longest >= 2e6 else (1e3, "thousand frames")
    for curve in curves:
        place = agents.index(curve.agent)
        colour = style.agent_colours(agents)[curve.agent]
        x = curve.frames / unit
        if np.isfinite(curve.low).any():
            axis.fill_between(x, curve.low, curve.high, color=colour, alpha=0.18, lw=0)
        marker = style.MARKERS[place % len(style.MARKERS)] if x.size <= 12 else None
        line = style.DASHES[place % len(style.DASHES)]
        axis.plot(x, curve.mean, color=colour, label=curve.agent, marker=marker, ls=line)
    for level, value in (levels or {}).items():
        axis.axhline(value, color=style.NEUTRAL, lw=1, ls="--")
        axis.annotate(level, (1, value), (-2, 2), xycoords=("axes fraction", "data"), textcoords="offset points",
                      ha="right", color=style.NEUTRAL, fontsize="small")  # fmt: skip
    axis.set_xlabel(name)


def curves_of_runs(
    groups: Mapping[tuple[str, str, str], Sequence[Run]], kind: str = "eval", confidence: float = 0.95
) -> list[Curve]:
    """A curve for each group, (agent, game, observability) -> its runs, that has logged something.

    It goes over the frames that all runs of the group have reached. ``kind`` is ``eval`` (greedy evaluations) or
    ``train`` (running mean of training returns, exploration included).
    """
    found = []
    for task, runs in groups.items():
        histories = [history for run in runs if (history := _history(run, kind))[0].size]
        if not histories:
            continue
        end = min(frames[-1] for frames, _ in histories)
        start = max(frames[0] for frames, _ in histories)
        longest = max((frames for frames, _ in histories), key=len)
        grid = longest[(longest >= start) & (longest <= end)] if kind == "eval" else np.linspace(start, end, POINTS)
        if grid.size:
            seeds = np.array([np.interp(grid, frames, values) for frames, values in histories])
            found.append(Curve(*task, grid, seeds, *over_seeds(seeds, confidence)))
    return found


def _history(run: Run, kind: str) -> tuple[Array, Array]:
    name, column = ("eval.csv", "mean") if kind == "eval" else ("metrics.csv", "train_return_ewm")
    rows = [row for row in run.table(name) if row.get(column)]
    try:
        frames = np.array([float(row["frames"]) for row in rows])
        return frames, np.array([float(row[column]) for row in rows])
    except ValueError as error:
        raise ValueError(f"{run.path / name} is damaged: {error}") from None
