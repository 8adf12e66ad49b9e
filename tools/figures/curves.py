"""Training curves: one panel a task, one line an agent, mean over seeds with a band."""

import math
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.curves import Curve, curves_of_runs
from arcade_torch.tools.figures.registry import Made, Request
from arcade_torch.tools.figures.runs import find_runs
from arcade_torch.tools.figures.style import (
    DASHES,
    MARKERS,
    TWIN_NAMES,
    agent_colour,
    drawing,
    footnote,
    inches,
    save,
    seeds_note,
)

KINDS = {"eval_final": "eval", "train_max_ewm": "train"}
AXIS = {"eval": "greedy return", "train": "training return, running mean"}


def make(request: Request) -> Made:
    """The figure ``curves``: greedy evaluations, or training returns with ``metric="train_max_ewm"``."""
    found = find_runs(request.runs)
    kind = KINDS.get(request.metric, "eval")
    groups = {key: [run.folder for run in runs] for key, runs in found.groups().items()}
    curves = curves_of_runs(groups, kind, request.confidence)
    if not curves:
        raise ValueError(f"no run below {request.runs[0]} has logged a {AXIS[kind]}: nothing to draw")
    tasks = list(dict.fromkeys((curve.game, curve.observability) for curve in curves))
    agents = list(dict.fromkeys(curve.agent for curve in curves))
    columns = min(4, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    with drawing(request.style) as plt:
        size = inches(request.style, max(5.5, 3.9 * columns), 0.8 + 3.0 * lines)
        figure, axes = plt.subplots(lines, columns, figsize=size, squeeze=False, layout="constrained")
        for axis in axes.flat[len(tasks) :]:
            axis.set_axis_off()
        of_game: dict[str, Any] = {}
        for axis, (game, twin) in zip(axes.flat, tasks, strict=False):
            axis.sharey(of_game.setdefault(game, axis))  # twins are there to be compared
            here = [curve for curve in curves if (curve.game, curve.observability) == (game, twin)]
            _panel(axis, here, agents)
            axis.set_title(f"{game}, {TWIN_NAMES.get(twin, twin)}")
            axis.set_ylabel(AXIS[kind])
        handles = {handle.get_label(): handle for axis in axes.flat for handle in axis.get_lines()}
        shown = [handles[agent] for agent in agents if agent in handles]
        figure.legend(handles=shown, loc="outside upper center", ncols=min(8, len(shown)))
        footnote(figure, seeds_note([len(curve.seeds) for curve in curves], request.confidence, "bands"))
        return Made(save(figure, request.out / "curves", _rows(curves)), found.notes + found.single_seeds())


def _panel(axis: Any, curves: list[Curve], agents: list[str]) -> None:
    longest = max(float(curve.frames[-1]) for curve in curves)
    unit, name = (1e6, "million frames") if longest >= 2e6 else (1e3, "thousand frames")
    for curve in curves:
        place = agents.index(curve.agent)
        colour = agent_colour(curve.agent, place)
        x = curve.frames / unit
        if np.isfinite(curve.low).any():
            axis.fill_between(x, curve.low, curve.high, color=colour, alpha=0.18, lw=0)
        marker = MARKERS[place % len(MARKERS)] if x.size <= 12 else None
        axis.plot(x, curve.mean, color=colour, label=curve.agent, marker=marker, ls=DASHES[place % len(DASHES)])
    axis.set_xlabel(name)


def _rows(curves: list[Curve]) -> list[dict[str, Any]]:
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
