"""Training curves: one panel a task, one line an agent, mean over seeds with a band."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.curves import Curve, curves_of_runs
from arcade_torch.tools.figures.registry import CurveOptions, Made, Picture, Progress
from arcade_torch.tools.figures.style import (
    DASHES,
    MARKERS,
    NEUTRAL,
    TWIN_NAMES,
    agent_colours,
    panels,
    rows_of,
    seeds_note,
)
from arcade_torch.tools.runs import find_runs

AXIS = {"eval": "greedy return", "train": "training return, running mean"}


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
    figure, axes = panels(lines, columns, (max(5.5, 3.9 * columns), 0.8 + 3.0 * lines))
    for axis in axes.flat[len(tasks) :]:
        axis.set_axis_off()
    of_game: dict[str, Any] = {}
    for axis, (game, twin) in zip(axes.flat, tasks, strict=False):
        axis.sharey(of_game.setdefault(game, axis))  # twins are there to be compared
        plot([curve for curve in every if (curve.game, curve.observability) == (game, twin)], axis, agents)
        axis.set(title=f"{game}, {TWIN_NAMES.get(twin, twin)}", ylabel=AXIS[kind])
    handles = {handle.get_label(): handle for axis in axes.flat for handle in axis.get_lines()}
    shown = [handles[agent] for agent in agents if agent in handles]
    figure.legend(handles=shown, loc="outside upper center", ncols=min(8, len(shown)))
    note = seeds_note([len(curve.seeds) for curve in every], options.confidence, "bands")
    return Made([Picture("curves", figure, note, _rows(every))], found.notes + found.single_seeds())


def plot(curves: Sequence[Curve], axis: Any, agents: Sequence[str], levels: Mapping[str, float] | None = None) -> None:
    """Draw the curves of one task."""
    longest = max(float(curve.frames[-1]) for curve in curves)
    unit, name = (1e6, "million frames") if longest >= 2e6 else (1e3, "thousand frames")
    for curve in curves:
        place = agents.index(curve.agent)
        colour = agent_colours(agents)[curve.agent]
        x = curve.frames / unit
        if np.isfinite(curve.low).any():
            axis.fill_between(x, curve.low, curve.high, color=colour, alpha=0.18, lw=0)
        marker = MARKERS[place % len(MARKERS)] if x.size <= 12 else None
        axis.plot(x, curve.mean, color=colour, label=curve.agent, marker=marker, ls=DASHES[place % len(DASHES)])
    for level, value in (levels or {}).items():
        axis.axhline(value, color=NEUTRAL, lw=1, ls="--")
        axis.annotate(level, (1, value), (-2, 2), xycoords=("axes fraction", "data"), textcoords="offset points",
                      ha="right", color=NEUTRAL, fontsize="small")  # fmt: skip
    axis.set_xlabel(name)


def _rows(curves: Sequence[Curve]) -> list[dict[str, Any]]:
    found = []
    for c in curves:
        what = {"agent": c.agent, "game": c.game, "observability": c.observability, "seeds": len(c.seeds)}
        found += rows_of(**what, frames=c.frames.astype(np.int64), mean=c.mean, low=c.low, high=c.high)
    return found
