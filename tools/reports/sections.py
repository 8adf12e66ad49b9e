"""Parts of the page: charts and tables from arrays and files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import percentile_interval, resampled_means
from arcade_torch.tools.analysis.curves import Curve
from arcade_torch.tools.analysis.gap_bias import GapBias
from arcade_torch.tools.analysis.normalise import normalise
from arcade_torch.tools.reports.charts import FULL, SMALL, Level, Line, Whisker, line_chart, whisker_chart
from arcade_torch.tools.reports.chosen import Finals, is_baseline
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study, flatten

Levels = Mapping[str, Mapping[str, Mapping[str, float]]]
TWIN_NAMES = {"full": "MDP", "partial": "POMDP"}
LEVEL_NAMES = {"random": "random", "state": "oracle", "frames": "frames oracle"}
PALETTE = 9
"""Colours of the page; the first is the memory-free agent's."""


@dataclass(frozen=True)
class Panel:
    """A chart, what stands below it, and the task it is of, as ``GAME-TWIN`` (empty where there are several)."""

    svg: str
    caption: str
    task: str = ""


def colours(agents: Sequence[str], baseline: str) -> dict[str, str]:
    """Colour class of every agent; the memory-free one is always ``c0``."""
    found: dict[str, str] = {}
    free = 1
    for agent in agents:
        if is_baseline(agent, baseline):
            found[agent] = "c0"
        else:
            found[agent] = f"c{1 + (free - 1) % (PALETTE - 1)}"
            free += 1
    return found


def curve_panels(
    curves: Sequence[Curve], levels: Levels, colour: Mapping[str, str], small: bool = False
) -> list[Panel]:
    """One chart a task; the twins of a game share their y axis. Small ones have a common legend elsewhere."""
    panels = []
    for game in dict.fromkeys(curve.game for curve in curves):
        of_game = [curve for curve in curves if curve.game == game]
        means = {kind: float(value["mean"]) for kind, value in levels.get(game, {}).items()}
        y_range = _range([*(curve.seeds for curve in of_game), np.array(list(means.values()))])
        for twin in dict.fromkeys(curve.observability for curve in of_game):
            here = [curve for curve in of_game if curve.observability == twin]
            shown = [kind for kind in LEVEL_NAMES if kind in means and not (kind == "frames" and twin == "full")]
            chart = line_chart(
                f"{game}, {TWIN_NAMES[twin]}",
                [_line(curve, colour) for curve in here],
                [Level(LEVEL_NAMES[kind], means[kind]) for kind in shown],
                y_range,
                SMALL if small else FULL,
            )
            panels.append(Panel(chart, "" if small else _seeds(here), f"{game}-{twin}"))
    return panels


def _seeds(curves: Sequence[Curve]) -> str:
    counts = sorted({len(curve.seeds) for curve in curves})
    seeds = " or ".join(map(str, counts)) + (" seed" if counts == [1] else " seeds")
    return f"mean of {seeds}" + ("; band: interval over seeds, thin lines: single seeds" if counts != [1] else "")


def _line(curve: Curve, colour: Mapping[str, str]) -> Line:
    return Line(curve.agent, colour[curve.agent], curve.frames, curve.mean, curve.low, curve.high, curve.seeds)


def _range(arrays: Sequence[Any]) -> tuple[float, float]:
    flat = np.concatenate([np.ravel(array) for array in arrays])
    low, high = float(flat.min()), float(flat.max())
    margin = 0.04 * (high - low) or 0.5
    return low - margin, high + margin


def whisker_panels(table: GapBias, colour: Mapping[str, str]) -> list[Panel]:
    """Normalised returns on both twins, Gap and Bias."""
    panels = []
    names = (("mdp", "MDP return"), ("pomdp", "POMDP return"), ("gap", "Gap"), ("bias", "Bias"))
    captions = {
        "mdp": "normalised to [0, 1]",
        "pomdp": "normalised to [0, 1]",
        "gap": "MDP - POMDP; small is good",
        "bias": "MDP - memory-free MDP; negative is a cost",
    }
    for name, title in names:
        values = [getattr(row, name) for row in table.rows]
        ends = np.array([[v.value, v.low, v.high] for v in values])
        low, high = float(np.nanmin(ends)), float(np.nanmax(ends))
        zero = name in ("gap", "bias")
        if zero:
            low, high = min(low, 0.0), max(high, 0.0)
        margin = 0.12 * (high - low) or 0.1
        rows = [
            Whisker(row.agent, colour.get(row.agent, "c0"), v.value, v.low, v.high)
            for row, v in zip(table.rows, values, strict=True)
        ]
        panels.append(Panel(whisker_chart(title, rows, (low - margin, high + margin), zero), captions[name]))
    return panels


def final_rows(finals: Finals, levels: Levels) -> list[dict[str, Any]]:
    """Rows of the table of final greedy returns."""
    found = []
    for (game, twin), agents in finals.items():
        means = {kind: float(value["mean"]) for kind, value in levels.get(game, {}).items()}
        for agent, values in agents.items():
            array = np.array(values, dtype=np.float64)
            mean = float(array.mean())
            draws = resampled_means([array], 2000, np.random.default_rng(0))
            interval = percentile_interval(mean, draws, 0.95, len(values) > 1)
            way = None
            if "random" in means and "state" in means and means["state"] != means["random"]:
                way = (mean - means["random"]) / (means["state"] - means["random"])
            found.append(
                {
                    "game": game,
                    "twin": TWIN_NAMES[twin],
                    "task": f"{game}-{twin}",
                    "agent": agent,
                    "mean": mean,
                    "interval": "" if np.isnan(interval.low) else f"[{interval.low:.3f}, {interval.high:.3f}]",
                    "seeds": "  ".join(f"{value:.3f}" for value in values),
                    "way": way,
                }
            )
    return found


def overviews(finals: Finals, agents: Sequence[str]) -> list[dict[str, Any]]:
    """For each twin a table of games by agents: mean return, its share of [0, 1] after normalising, which is best."""
    found = []
    for twin in dict.fromkeys(key[1] for key in finals):
        rows = []
        for game in (key[0] for key in finals if key[1] == twin):
            means = {agent: float(np.mean(values)) for agent, values in finals[game, twin].items()}
            best = max(means.values())
            cells = [
                None
                if agent not in means
                else {
                    "value": means[agent],
                    "heat": round(100 * min(1.0, max(0.0, float(normalise(game, means[agent]))))),
                    "best": means[agent] == best,
                }
                for agent in agents
            ]
            rows.append({"game": game, "task": f"{game}-{twin}", "cells": cells})
        found.append({"twin": TWIN_NAMES[twin], "agents": list(agents), "rows": rows})
    return found


Settings = Mapping[str, Mapping[str, Any]]
_MISSING = object()


def all_settings(folder: StudyFolder, study: Study) -> dict[str, dict[str, Any]]:
    """Resolved settings of every run that was started, by its name."""
    found = {}
    for run in study.runs():
        here = folder.run(run)
        if (here.path / "config.json").exists():
            found[run.name] = flatten(here.config())
    return found


def shared_settings(settings: Settings) -> dict[str, Any]:
    """Resolved settings that all runs have in common."""
    every = list(settings.values())
    if not every:
        return {}
    return {
        key: value for key, value in every[0].items() if all(other.get(key, _MISSING) == value for other in every[1:])
    }


def run_details(
    folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]], settings: Settings, shared: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """For every run: its command, its resolved settings where they differ from the shared ones, and its numbers."""
    found = []
    for run, row in zip(study.runs(), rows, strict=True):
        own = {key: value for key, value in settings.get(run.name, {}).items() if shared.get(key, _MISSING) != value}
        command = study.command(run, folder.run(run).path)
        found.append({"row": row, "name": run.name, "command": command, "own": own})
    return found
