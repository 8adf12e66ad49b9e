"""Build the report of a study: numbers first, then one page that holds everything."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.analysis.bootstrap import over_seeds
from arcade_torch.tools.analysis.gap_bias import GapBias, gap_and_bias, normalise
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures.style import TWIN_NAMES, agent_colours
from arcade_torch.tools.files import write_csv
from arcade_torch.tools.options import command_line
from arcade_torch.tools.players import Baseline, references
from arcade_torch.tools.reports import findings, panels
from arcade_torch.tools.reports.panels import Finals, Progress, select_cells
from arcade_torch.tools.runs import METRICS, Runs, flatten, open_run
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study

TEMPLATES = Path(__file__).resolve().parent.parent / "templates"
MANY_PANELS = 8  # from here on pictures of learning are small
MANY_ROWS = 24  # from here on long tables are folded away behind a short one
MANY_RUNS = 48  # from here on the runs stand in one table, without their commands

Players = Mapping[str, Mapping[str, Baseline]]  # game -> player -> what it earned


def report(
    root: str | Path,
    out: str | Path | None = None,
    *,
    metric: str = "eval_final",
    saliency: bool = True,
    recall: bool = True,
    contamination: bool = True,
    references: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Write the page of a study, one HTML file that loads nothing, and return its path.

    Missing analyses are made on the way and kept, in the study's folder or in those of its runs, under ``analysis``. Of
    a large study only a few agents and games are looked into, and the page says which.

    Args:
        root: folder of the study.
        out: the page; ``report.html`` in the folder by default.
        metric: score of a run that headline and table rest on, ``eval_final`` or ``train_max_ewm``.
        saliency: whether to draw saliency strips.
        recall: whether to measure recall density.
        contamination: whether to measure state contamination.
        references: whether to draw the returns of the random policy and the oracles.
        progress: called with (what, done, total).

    Raises:
        FileNotFoundError: ``root`` is no study.
        ValueError: no run has finished yet.
        MissingPackage: jinja2 is not installed.
    """
    jinja2 = need("jinja2")
    folder = StudyFolder(Path(root))
    study = folder.load()
    rows = folder.write_results(study)
    started = [folder.run(run).path for run, row in zip(study.runs(), rows, strict=True) if row["status"] == "finished"]
    runs = Runs(tuple(run for path in started if (run := open_run(path)) is not None))
    if not runs.runs:
        raise ValueError(f"no run of {folder.root} has finished yet: nothing to report")
    agents = list(dict.fromkeys(runs.names[run.key] for run in runs.runs))
    finals: dict[tuple[str, str], dict[str, list[float]]] = {}
    for (agent, game, twin), group in runs.groups().items():
        finals.setdefault((game, twin), {})[agent] = [run.value("eval_final") for run in group]
    cells, note = select_cells(runs, finals, study.baseline)
    context = {
        "study": study,
        "made": time.strftime("%Y-%m-%d %H:%M"),
        "rows": rows,
        "unfinished": [row for row in rows if row["status"] != "finished"],
        **_learning(runs, finals, agents, _players(folder, runs, progress) if references else {}),
        **_scores(folder, study, runs, metric),
        **_repeat(folder, study, rows),
        "note": note,
        "strips": panels.saliency_strips(cells, progress) if saliency else [],
        "recall": panels.recall_section(cells, agents, progress) if recall else None,
        "contamination": panels.contamination_section(cells, agents, progress) if contamination else None,
        "density": panels.DENSITY,
        "noise": panels.NOISE,
        "bins": panels.BINS,
        "colours": {agent: f"c{place}" for place, agent in enumerate(agents)},
        "palette": list(agent_colours(agents).values()),
        "many_rows": MANY_ROWS,
        "many_runs": MANY_RUNS,
    }
    loader = jinja2.FileSystemLoader(TEMPLATES)
    strict = {"autoescape": True, "undefined": jinja2.StrictUndefined}
    environment = jinja2.Environment(loader=loader, trim_blocks=True, lstrip_blocks=True, **strict)
    environment.filters["commas"] = "{:,}".format
    page = environment.get_template("report.html.j2").render(context)
    return write_atomic(Path(out) if out is not None else folder.root / "report.html", page)


def _players(folder: StudyFolder, runs: Runs, progress: Progress | None) -> Players:
    """What the players earn under the rules and options that the study was trained with."""
    found, configs = {}, {run.game: run.config for run in reversed(runs.runs)}
    for done, game in enumerate(dict.fromkeys(run.game for run in runs.runs), start=1):
        rules, options = str(configs[game].get("rules", "default")), dict(configs[game].get("env_options") or {})
        found[game] = references(game, folder.analysis, rules, options)
        if progress is not None:
            progress("random policy and oracles", done, len(configs))
    return found


def _learning(runs: Runs, finals: Finals, agents: Sequence[str], players: Players) -> dict[str, Any]:
    """Curves, and the final greedy returns as sentences, rows and overviews."""
    levels = {game: {name: row.mean for name, row in rows.items()} for game, rows in players.items()}
    sentences, rows = [], []
    for (game, twin), by_agent in finals.items():
        sentences.append(findings.learning_sentence(game, twin, by_agent, levels.get(game, {})))
        for agent, values in by_agent.items():
            mean, low, high = map(float, over_seeds(np.array(values, dtype=np.float64)))
            row: dict[str, Any] = {"game": game, "twin": TWIN_NAMES[twin], "task": f"{game}-{twin}", "agent": agent}
            row |= {"mean": mean, "low": low, "high": high, "seeds": "  ".join(f"{value:.3f}" for value in values)}
            rows.append(row | {"way": findings.way(mean, levels.get(game, {}))})
    small = len(finals) > MANY_PANELS
    return {
        "learning": [sentence for sentence in sentences if sentence],
        "small": small,
        "curves": panels.curve_panels(runs, "eval", levels, agents, small),
        "train_curves": [] if small else panels.curve_panels(runs, "train", levels, agents, small),
        "finals": rows,
        "overviews": _overviews(finals, agents) if len({game for game, _ in finals}) > 2 else [],
        "players": players,
    }


def _overviews(finals: Finals, agents: Sequence[str]) -> list[dict[str, Any]]:
    """For each twin a table of games by agents: mean return, its share of [0, 1] after normalising, which is best."""
    found: dict[str, list[dict[str, Any]]] = {}
    for (game, twin), by_agent in finals.items():
        means = {agent: float(np.mean(values)) for agent, values in by_agent.items()}
        cells: dict[str, Any] = dict.fromkeys(agents)
        for agent, mean in means.items():
            heat = round(100 * min(1.0, max(0.0, normalise(game, mean))))
            cells[agent] = {"value": mean, "heat": heat, "best": mean == max(means.values())}
        found.setdefault(twin, []).append({"game": game, "task": f"{game}-{twin}", "cells": list(cells.values())})
    return [{"twin": TWIN_NAMES[twin], "agents": list(agents), "rows": rows} for twin, rows in found.items()]


def _scores(folder: StudyFolder, study: Study, runs: Runs, metric: str) -> dict[str, Any]:
    """Gap and bias by both metrics, also written as CSV, and what they say; or why there are none."""
    baseline = study.baseline if len(study.algorithms) == 1 else f"{study.algorithms[0]}-{study.baseline}"
    tables, trouble = dict[str, GapBias | None](), list[str]()
    for name in sorted(METRICS, key=lambda name: name != metric):
        try:
            table = tables[name] = gap_and_bias(runs.scores(name), metric=name, baseline=baseline)
            rows = table.table()
            write_csv(folder.analysis / f"gap_bias_{name}.csv", rows, list(rows[0]))
        except ValueError as error:
            tables[name] = None
            trouble.append(str(error))
    first, second = tables.values()
    sentences = findings.score_sentences(first) if first else []
    return {
        "table": first,
        "second": second,
        "trouble": trouble[0] if trouble else "",
        "score_panels": panels.score_panels(first) if first else [],
        "headlines": sentences[:3],
        "more": sentences[3:],
        "caution": findings.coverage_sentence(first) if first else "",
    }


def _repeat(folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Commands, versions and settings; settings of a run where they differ from those that all runs share."""
    record, here = folder.record(), {run.name: folder.run(run) for run in study.runs()}
    settings = {name: flatten(run.config) for name, run in here.items() if (run.path / "config.json").exists()}
    shared: dict[str, Any] = dict(next(iter(settings.values()), {}))
    for other in settings.values():
        shared = {key: value for key, value in shared.items() if key in other and other[key] == value}
    commands = record["runs"] if isinstance(record.get("runs"), dict) else {}
    details = []
    for name, row in zip(here, rows, strict=True):
        own = {key: value for key, value in settings.get(name, {}).items() if key not in shared}
        details.append({"row": row, "name": name, "command": commands.get(name, ""), "own": own})
    return {
        "shared": shared,
        "runs": details,
        "versions": record.get("versions") or {},
        "also": record.get("also") or [],
        "command": record.get("command", ""),
        "report_command": command_line(["report", str(folder.root)]),
        "seconds": sum(float(row.get("seconds") or 0) for row in rows),
    }
