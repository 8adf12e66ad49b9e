"""Build the report of a study: numbers first, then one page that holds everything."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import percentile_interval, resampled_means
from arcade_torch.tools.analysis.gap_bias import GapBias, gap_and_bias
from arcade_torch.tools.analysis.normalise import normalise
from arcade_torch.tools.extensions import command_line
from arcade_torch.tools.figures.style import TWIN_NAMES, agent_colours
from arcade_torch.tools.files import write_csv, write_text
from arcade_torch.tools.optional import need
from arcade_torch.tools.players import Baseline, references
from arcade_torch.tools.reports import findings, panels
from arcade_torch.tools.reports.panels import Progress
from arcade_torch.tools.reports.selection import Finals, select_cells
from arcade_torch.tools.runs import Runs, open_run
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study, flatten

TEMPLATES = Path(__file__).resolve().parent.parent / "templates"
MANY_PANELS = 8
"""From here on pictures of learning are small."""
MANY_ROWS = 24
"""From here on long tables are folded away behind a short one."""
MANY_RUNS = 48
"""From here on the runs stand in one table, without their commands."""

Players = Mapping[str, Mapping[str, Baseline]]
"""Game -> player -> what it earned."""


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
    """Write the page of a study: one HTML file that loads nothing.

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

    Returns:
        Path of the page.

    Raises:
        FileNotFoundError: ``root`` is no study.
        ValueError: no run has finished yet.
        MissingPackage: jinja2 is not installed.
    """
    jinja2 = need("jinja2")
    folder = StudyFolder(Path(root))
    study = folder.load()
    rows = folder.write_results(study)
    started = [folder.run(run) for run, row in zip(study.runs(), rows, strict=True) if row["status"] == "finished"]
    runs = Runs(tuple(run for one in started if (run := open_run(one)) is not None))
    if not runs.runs:
        raise ValueError(f"no run of {folder.root} has finished yet: nothing to report")
    players = _players(folder, study, runs, progress) if references else {}
    finals, agents = _finals(runs), list(dict.fromkeys(runs.names[run.key] for run in runs.runs))
    cells, note = select_cells(runs, finals, study.baseline)
    context = (
        _learning(runs, finals, agents, players) | _scores(folder, study, runs, metric) | _repeat(folder, study, rows)
    )
    context |= {
        "study": study,
        "made": time.strftime("%Y-%m-%d %H:%M"),
        "rows": rows,
        "unfinished": [row for row in rows if row["status"] != "finished"],
        "note": note,
        "cells": cells,
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
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["commas"] = lambda value: f"{int(value):,}"
    page = environment.get_template("report.html.j2").render(context)
    return write_text(Path(out) if out is not None else folder.root / "report.html", page)


def _players(folder: StudyFolder, study: Study, runs: Runs, progress: Progress | None) -> Players:
    """What the players earn under the rules and options that the study was trained with."""
    found, games = {}, list(dict.fromkeys(run.game for run in runs.runs))
    for done, game in enumerate(games, start=1):
        config = next(run.config for run in runs.runs if run.game == game)
        rules, options = str(config.get("rules", "default")), dict(config.get("env_options") or {})
        found[game] = references(game, folder.analysis, rules, options)
        if progress is not None:
            progress("random policy and oracles", done, len(games))
    return found


def _finals(runs: Runs) -> dict[tuple[str, str], dict[str, list[float]]]:
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for (agent, game, twin), group in runs.groups().items():
        found.setdefault((game, twin), {})[agent] = [run.value("eval_final") for run in group]
    return found


def _learning(runs: Runs, finals: Finals, agents: Sequence[str], players: Players) -> dict[str, Any]:
    levels = {game: {name: row.mean for name, row in rows.items()} for game, rows in players.items()}
    small = len(finals) > MANY_PANELS
    learning = [findings.learning_sentence(*key, finals[key], levels.get(key[0], {})) for key in finals]
    return {
        "learning": [sentence for sentence in learning if sentence],
        "small": small,
        "curves": panels.curve_panels(runs, "eval", levels, agents, small),
        "train_curves": [] if small else panels.curve_panels(runs, "train", levels, agents, small),
        "finals": _final_rows(finals, levels),
        "overviews": _overviews(finals, agents) if len({game for game, _ in finals}) > 2 else [],
        "players": players,
    }


def _final_rows(finals: Finals, levels: panels.Levels) -> list[dict[str, Any]]:
    """Rows of the table of final greedy returns."""
    found = []
    for (game, twin), agents in finals.items():
        low, high = (levels.get(game, {}).get(kind) for kind in ("random", "state"))
        for agent, values in agents.items():
            array = np.array(values, dtype=np.float64)
            mean = float(array.mean())
            draws = resampled_means([array], 2000, np.random.default_rng(0))
            row: dict[str, Any] = {"game": game, "twin": TWIN_NAMES[twin], "task": f"{game}-{twin}", "agent": agent}
            row |= {"mean": mean, "interval": percentile_interval(mean, draws, 0.95, len(values) > 1)}
            way = None if low is None or high is None or high == low else (mean - low) / (high - low)
            found.append(row | {"seeds": "  ".join(f"{value:.3f}" for value in values), "way": way})
    return found


def _overviews(finals: Finals, agents: Sequence[str]) -> list[dict[str, Any]]:
    """For each twin a table of games by agents: mean return, its share of [0, 1] after normalising, which is best."""
    found = []
    for twin in dict.fromkeys(key[1] for key in finals):
        rows = []
        for game in (key[0] for key in finals if key[1] == twin):
            means = {agent: float(np.mean(values)) for agent, values in finals[game, twin].items()}
            heat = {agent: round(100 * min(1.0, max(0.0, normalise(game, mean)))) for agent, mean in means.items()}
            best = max(means.values())
            cells = [
                {"value": means[agent], "heat": heat[agent], "best": means[agent] == best} if agent in means else None
                for agent in agents
            ]
            rows.append({"game": game, "task": f"{game}-{twin}", "cells": cells})
        found.append({"twin": TWIN_NAMES[twin], "agents": list(agents), "rows": rows})
    return found


def _scores(folder: StudyFolder, study: Study, runs: Runs, metric: str) -> dict[str, Any]:
    table, trouble = _table(folder, study, runs, metric)
    second, _ = _table(folder, study, runs, "train_max_ewm" if metric == "eval_final" else "eval_final")
    sentences = []
    for row in sorted(table.rows[1:], key=lambda row: -row.pomdp.value) if table else []:
        assert table is not None
        sentences += [findings.gap_sentence(table, row.agent), findings.pomdp_sentence(table, row.agent)]
        sentences += [findings.bias_sentence(row)]
    return {
        "table": table,
        "second": second,
        "trouble": trouble,
        "score_panels": panels.score_panels(table) if table else [],
        "headlines": sentences[:3],
        "more": sentences[3:],
        "caution": findings.coverage_sentence(table) if table else "",
    }


def _table(folder: StudyFolder, study: Study, runs: Runs, metric: str) -> tuple[GapBias | None, str]:
    """Gap and bias, also written as CSV; or why there is none."""
    baseline = study.baseline if len(study.algorithms) == 1 else f"{study.algorithms[0]}-{study.baseline}"
    try:
        table = gap_and_bias(runs.scores(metric), metric=metric, baseline=baseline)
    except ValueError as error:
        return None, str(error)
    rows = table.table()
    write_csv(folder.analysis / f"gap_bias_{metric}.csv", rows, list(rows[0]))
    return table, ""


def _repeat(folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Commands, versions and settings; settings of a run where they differ from those that all runs share."""
    record, settings = folder.record(), dict[str, dict[str, Any]]()
    for run in study.runs():
        if (folder.run(run).path / "config.json").exists():
            settings[run.name] = flatten(folder.run(run).config())
    shared: dict[str, Any] = dict(next(iter(settings.values()), {}))
    for other in settings.values():
        shared = {key: value for key, value in shared.items() if key in other and other[key] == value}
    commands = record["runs"] if isinstance(record.get("runs"), dict) else {}
    details = [
        {
            "row": row,
            "name": run.name,
            "command": commands.get(run.name, ""),
            "own": {key: value for key, value in settings.get(run.name, {}).items() if key not in shared},
        }
        for run, row in zip(study.runs(), rows, strict=True)
    ]
    return {
        "shared": shared,
        "runs": details,
        "versions": record.get("versions") or {},
        "also": record.get("also") or [],
        "command": record.get("command", ""),
        "report_command": command_line(["report", str(folder.root)]),
        "seconds": sum(float(row.get("seconds") or 0) for row in rows),
    }
