"""Training curves: one panel a task, one line an agent, mean over seeds with a band."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from arcade_torch.tools.analysis.curves import Curve, curves_of_runs
from arcade_torch.tools.figures import registry
from arcade_torch.tools.figures.registry import Made, Progress
from arcade_torch.tools.figures.style import (
    DASHES,
    MARKERS,
    NEUTRAL,
    TWIN_NAMES,
    agent_colours,
    drawing,
    footnote,
    inches,
    save,
    seeds_note,
)
from arcade_torch.tools.runs import find_runs

AXIS = {"eval": "greedy return", "train": "training return, running mean"}


@dataclass
class Options(registry.Options):
    """Options of the figure."""

    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Greedy evaluations, or training returns with exploration in them."""
    confidence: float = 0.95
    """Of the bands."""


def make(options: Options, progress: Progress | None) -> Made:
    """The figure ``curves``."""
    found = find_runs(options.runs)
    kind = "eval" if options.metric == "eval_final" else "train"
    groups = found.groups()
    curves = curves_of_runs(groups, kind, options.confidence)
    if not curves:
        raise ValueError(f"no run below {options.runs[0]} has logged a {AXIS[kind]}: nothing to draw")
    tasks = list(dict.fromkeys((curve.game, curve.observability) for curve in curves))
    agents = list(dict.fromkeys(curve.agent for curve in curves))
    columns = min(4, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    with drawing(options.style) as plt:
        size = inches(options.style, max(5.5, 3.9 * columns), 0.8 + 3.0 * lines)
        figure, axes = plt.subplots(lines, columns, figsize=size, squeeze=False, layout="constrained")
        for axis in axes.flat[len(tasks) :]:
            axis.set_axis_off()
        of_game: dict[str, Any] = {}
        for axis, (game, twin) in zip(axes.flat, tasks, strict=False):
            axis.sharey(of_game.setdefault(game, axis))  # twins are there to be compared
            plot([curve for curve in curves if (curve.game, curve.observability) == (game, twin)], axis, agents)
            axis.set_title(f"{game}, {TWIN_NAMES.get(twin, twin)}")
            axis.set_ylabel(AXIS[kind])
        handles = {handle.get_label(): handle for axis in axes.flat for handle in axis.get_lines()}
        shown = [handles[agent] for agent in agents if agent in handles]
        figure.legend(handles=shown, loc="outside upper center", ncols=min(8, len(shown)))
        footnote(figure, seeds_note([len(curve.seeds) for curve in curves], options.confidence, "bands"))
        rows = _rows(curves)
        return Made(save(options, "curves", figure, rows), found.notes + found.single_seeds(), rows=rows)


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
    return [
        {
            "agent": curve.agent,
            "game": curve.game,
            "observability": curve.observability,
            "seeds": len(curve.seeds),
            "frames": int(curve.frames[i]),
            "mean": curve.mean[i],
            "low": curve.low[i],
            "high": curve.high[i],
        }
        for curve in curves
        for i in range(curve.frames.size)
    ]
