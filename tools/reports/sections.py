"""Parts of the page: charts and tables from arrays and files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import percentile_interval, resampled_means
from arcade_torch.tools.analysis.curves import Curve
from arcade_torch.tools.analysis.gap_bias import GapBias
from arcade_torch.tools.reports.charts import Level, Line, Whisker, line_chart, whisker_chart
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study, flatten

Levels = Mapping[str, Mapping[str, Mapping[str, float]]]
TWIN_NAMES = {"full": "MDP", "partial": "POMDP"}
LEVEL_NAMES = {"random": "random", "state": "oracle", "frames": "frames oracle"}
PALETTE = 6


@dataclass(frozen=True)
class Panel:
    """A chart and what stands below it."""

    svg: str
    caption: str


def colours(agents: Sequence[str], baseline: str) -> dict[str, str]:
    """Colour class of every agent; the memory-free one is always ``c0``."""
    found: dict[str, str] = {}
    free = 1
    for agent in agents:
        if agent == baseline or agent.endswith(f"-{baseline}"):
            found[agent] = "c0"
        else:
            found[agent] = f"c{1 + (free - 1) % (PALETTE - 1)}"
            free += 1
    return found


def curve_panels(curves: Sequence[Curve], levels: Levels, colour: Mapping[str, str]) -> list[Panel]:
    """One chart a task; the twins of a game share their y axis."""
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
            )
            counts = sorted({len(curve.seeds) for curve in here})
            seeds = " or ".join(map(str, counts)) + (" seed" if counts == [1] else " seeds")
            band = "; band: interval over seeds, thin lines: single seeds" if counts != [1] else ""
            panels.append(Panel(chart, f"mean of {seeds}{band}"))
    return panels


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


def final_rows(finals: Mapping[tuple[str, str], Mapping[str, Sequence[float]]], levels: Levels) -> list[dict[str, Any]]:
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
                    "agent": agent,
                    "mean": mean,
                    "interval": "" if np.isnan(interval.low) else f"[{interval.low:.3f}, {interval.high:.3f}]",
                    "seeds": "  ".join(f"{value:.3f}" for value in values),
                    "way": way,
                }
            )
    return found


def run_details(folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For every run: its command, its resolved settings where they differ from the shared ones, and its numbers."""
    shared = shared_settings(folder, study)
    found = []
    for run, row in zip(study.runs(), rows, strict=True):
        path = folder.run(run).path
        settings = _settings(folder, study, run.name)
        own = {key: value for key, value in settings.items() if shared.get(key, _MISSING) != value}
        found.append({"row": row, "name": run.name, "command": study.command(run, path), "own": own})
    return found


_MISSING = object()


def shared_settings(folder: StudyFolder, study: Study) -> dict[str, Any]:
    """Resolved settings that all runs have in common."""
    every = [settings for run in study.runs() if (settings := _settings(folder, study, run.name))]
    if not every:
        return {}
    return {
        key: value for key, value in every[0].items() if all(other.get(key, _MISSING) == value for other in every[1:])
    }


def _settings(folder: StudyFolder, study: Study, name: str) -> dict[str, Any]:
    run = next(run for run in study.runs() if run.name == name)
    file = folder.run(run).path / "config.json"
    return flatten(folder.run(run).config()) if file.exists() else {}
