"""Build the report of a study: numbers first, then one page that holds everything.

Its sentences are computed from numbers: they claim a difference only where its interval excludes
zero.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from arcade_torch.agents.config import TrainConfig, flatten, require
from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.analysis.bootstrap import pooled
from arcade_torch.tools.analysis.gap_bias import GapBias, gap_and_bias, normalise
from arcade_torch.tools.comparable import Runs, check_comparable
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import Part, Progress
from arcade_torch.tools.figures.style import TWIN_NAMES, agent_colours, agents_by_task, drawing
from arcade_torch.tools.files import write_csv
from arcade_torch.tools.options import command_line
from arcade_torch.tools.players import Baseline, references
from arcade_torch.tools.reports import panels
from arcade_torch.tools.reports.panels import Finals, select_cells
from arcade_torch.tools.runs import open_run
from arcade_torch.tools.scores import METRICS
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study

MANY_PANELS = 8  # from here on pictures of learning are small
# below this measured coverage a difference is one of the seeds that were run
TRUSTED_COVERAGE = 0.85

# Number of the table -> the fact; then how it goes on: a single seed, an interval without zero, one
# with zero.
SENTENCES = {
    "gap": (
        "Partial observability costs the memory-free agent {base:.2f} of normalised return and "
        "{agent} {own:.2f}: ",
        "a difference of {value:+.2f} with a single seed, which says nothing about others.",
        "{where} {verb} the observability gap by {size:.2f} [{near:.2f}, {far:.2f}].",
        "with memory the gap is {size:.2f} {side}, but the interval {ends} contains zero, so "
        "{seeds} seeds do not "
        "settle it.",
    ),
    "pomdp": (
        "On the POMDP {agent} reaches a normalised return of {own:.2f}, the memory-free agent "
        "{base:.2f}",
        ".",
        ", a difference of {value:+.2f} {ends}.",
        "; the interval of the difference {ends} contains zero.",
    ),
    "bias": (
        "On the MDP, where memory is not needed, {agent} {effect} {size:.2f} against the "
        "memory-free agent",
        ".",
        " (bias {ends}).",
        ", which is within the noise (bias {ends} contains zero).",
    ),
}

Players = Mapping[str, Mapping[str, Baseline]]  # game -> player -> what it earned


def report(
    root: str | Path,
    out: str | Path | None = None,
    *,
    metric: str = "eval_final",
    skip: Sequence[Part] = (),
    progress: Progress | None = None,
) -> Path:
    """Write the page of a study, one HTML file that loads nothing, and return its path.

    Missing analyses are made on the way and kept, in the study's folder or in those of its runs,
    under ``analysis``. Of a large study only a few agents and games are looked into, and the page
    says which.

    Args:
        root: folder of the study.
        out: the page; ``report.html`` in the folder by default.
        metric: score of a run that headline and table rest on, ``eval_final`` or ``train_max_ewm``.
        skip: parts to leave out: saliency strips, recall density, state contamination, returns of
            random policy and oracles.
        progress: called with (what, done, total).

    Raises:
        FileNotFoundError: ``root`` is no study.
        ValueError: no run has finished yet, or there is no such part.
        MissingPackage: jinja2 is not installed.
    """
    require(metric in METRICS, "metric", metric, f"one of {', '.join(METRICS)}")
    if unknown := sorted(set(skip) - set(get_args(Part))):
        raise ValueError(
            f"a report has no part {unknown[0]!r} to skip; parts: {', '.join(get_args(Part))}"
        )
    jinja2 = need("jinja2")
    folder = StudyFolder(Path(root))
    study = folder.load()
    rows = folder.write_results(study)
    started = [
        folder.run(run).path
        for run, row in zip(study.runs(), rows, strict=True)
        if row["status"] == "finished"
    ]
    runs = Runs(tuple(run for path in started if (run := open_run(path)) is not None))
    if not runs.runs:
        raise ValueError(f"no run of {folder.root} has finished yet: nothing to report")
    check_comparable(runs)
    agents = list(dict.fromkeys(runs.names[run.key] for run in runs.runs))
    finals = agents_by_task(
        {task: [run.value("eval_final") for run in group] for task, group in runs.groups().items()}
    )
    cells, note = select_cells(runs, finals, study.baseline)
    with drawing("light"):
        context = {
            "study": study,
            "made": time.strftime("%Y-%m-%d %H:%M"),
            "rows": rows,
            **_learning(
                runs,
                finals,
                agents,
                _players(folder, runs, progress) if "references" not in skip else {},
            ),
            **_scores(folder, study, runs, metric),
            **_repeat(folder, study, rows),
            "note": note,
            "strips": panels.saliency_strips(cells, progress) if "saliency" not in skip else [],
            "recall": panels.recall_section(cells, agents, progress)
            if "recall" not in skip
            else None,
            "contamination": None
            if "contamination" in skip
            else panels.contamination_section(cells, agents, progress),
            "panels": panels,
            "colours": {agent: f"c{place}" for place, agent in enumerate(agents)},
            "palette": list(agent_colours(agents).values()),
        }
    loader = jinja2.PackageLoader("arcade_torch.tools")
    strict = {"autoescape": True, "undefined": jinja2.StrictUndefined}
    environment = jinja2.Environment(loader=loader, trim_blocks=True, lstrip_blocks=True, **strict)
    environment.filters["commas"] = "{:,}".format
    page = environment.get_template("report.html.j2").render(context)
    return write_atomic(Path(out) if out is not None else folder.root / "report.html", page)


def _players(folder: StudyFolder, runs: Runs, progress: Progress | None) -> Players:
    """What the players earn under the rules and options that the study was trained with."""
    found = {}
    configs = {run.game: run.config for run in reversed(runs.runs)}
    for done, game in enumerate(dict.fromkeys(run.game for run in runs.runs), start=1):
        rules = str(configs[game].get("rules", "default"))
        options = dict(configs[game].get("env_options") or {})
        found[game] = references(game, folder.analysis, rules, options)
        if progress is not None:
            progress("random policy and oracles", done, len(configs))
    return found


def _learning(
    runs: Runs, finals: Finals, agents: Sequence[str], players: Players
) -> dict[str, Any]:
    """Curves, and the final greedy returns as sentences, rows and overviews."""
    levels = {
        game: {name: row.mean for name, row in rows.items()} for game, rows in players.items()
    }
    sentences = list[str]()
    rows = list[dict[str, Any]]()
    tables = dict[str, list[dict[str, Any]]]()
    for (game, twin), by_agent in finals.items():
        task = {"game": game, "twin": TWIN_NAMES[twin], "task": f"{game}-{twin}"}
        level = levels.get(game, {})
        sentences.append(learning_sentence(game, twin, by_agent, level))
        cells: dict[str, Any] = dict.fromkeys(agents)
        for agent, values in by_agent.items():
            mean, low, high = map(float, pooled(values)[1:])
            row = {"agent": agent, "mean": mean, "low": low, "high": high, "way": way(mean, level)}
            rows.append(task | row | {"seeds": "  ".join(f"{value:.3f}" for value in values)})
            cells[agent] = {
                "value": mean,
                "heat": round(100 * min(1.0, max(0.0, normalise(game, mean)))),
            }
        tables.setdefault(TWIN_NAMES[twin], []).append(task | {"cells": cells})
    small = len(finals) > MANY_PANELS
    return {
        "learning": list(filter(None, sentences)),
        "small": small,
        "curves": panels.curve_panels(runs, "eval", levels, agents, small),
        "train_curves": [] if small else panels.curve_panels(runs, "train", levels, agents, small),
        "finals": rows,
        "overviews": tables,
        "players": players,
    }


def _scores(folder: StudyFolder, study: Study, runs: Runs, metric: str) -> dict[str, Any]:
    """Gap and bias by both metrics, also written as CSV, and what they say; or why there are
    none.
    """
    found: dict[str, Any] = {
        "trouble": "",
        "table": None,
        "second": None,
        "sentences": [],
        "caution": "",
    }
    for place, name in zip(
        ("table", "second"), sorted(METRICS, key=lambda name: name != metric), strict=True
    ):
        try:
            table = found[place] = gap_and_bias(
                runs.scores(name), metric=name, baseline=study.baseline
            )
            write_csv(folder.analysis / f"gap_bias_{name}.csv", table.table())
        except ValueError as error:
            found["trouble"] = found["trouble"] or str(error)
    if (table := found["table"]) is not None:
        rows = [row for row in table.rows if table.baselines[row.agent] not in (None, row.agent)]
        agents = [row.agent for row in sorted(rows, key=lambda row: -row.pomdp.value)]
        found["sentences"] = [
            score_sentence(table, name, agent) for agent in agents for name in SENTENCES
        ]
        found |= {"score_panels": panels.score_panels(table), "caution": coverage_sentence(table)}
    return found


def score_sentence(table: GapBias, name: str, agent: str) -> str:
    """One of `SENTENCES` about an agent with memory, and how sure it is."""
    base = table.row(table.baselines[agent] or table.baseline)
    row = table.row(agent)
    difference = table.difference(
        name, *((base.agent, agent) if name == "gap" else (agent, base.agent))
    )
    value, low, high = found = row.bias if name == "bias" else difference
    fact, single, clear, vague = SENTENCES[name]
    ending = single if low != low else clear if found.excludes_zero else vague
    seeds = min(base.seeds, row.seeds)
    weak = min(base.coverage, row.coverage) < TRUSTED_COVERAGE
    near, far = sorted((abs(low), abs(high)))
    return f"{fact}{ending}".format(
        **{
            "agent": agent,
            "base": getattr(base, name).value,
            "own": getattr(row, name).value,
            "seeds": seeds,
        },
        **{
            "value": value,
            "size": abs(value),
            "near": near,
            "far": far,
            "ends": f"[{low:+.2f}, {high:+.2f}]",
        },
        where=f"over these {seeds} seeds memory" if weak else "memory",
        verb="narrows" if value > 0 else "widens",
        side="smaller" if value > 0 else "larger",
        effect="costs" if value < 0 else "adds",
    )


def coverage_sentence(table: GapBias) -> str:
    """How much the intervals are worth with so few seeds."""
    if not table.coverage:
        return (
            "With a single seed there are no intervals: repeat with more seeds before believing a "
            "difference."
        )
    seeds, share = min(table.coverage.items())
    return (
        f"Intervals are nominal {100 * table.confidence:g} % percentile bootstrap over seeds. "
        f"With {seeds} seeds such an interval held the true gap in {100 * share:.0f} % of "
        "simulated "
        "studies, so it is narrower than it claims."
    )


def way(value: float, levels: Mapping[str, float]) -> float | None:
    """The share of the way from the random policy to the oracle; None where that is not known."""
    low = levels.get("random")
    high = levels.get("state")
    return None if low is None or high is None or high == low else (value - low) / (high - low)


def learning_sentence(
    game: str, twin: str, finals: Mapping[str, Sequence[float]], levels: Mapping[str, float]
) -> str:
    """Where the agents of one task ended between the random policy and the oracle; empty where that
    is not known.
    """
    ways = {agent: way(sum(values) / len(values), levels) for agent, values in finals.items()}
    if not ways or None in ways.values():
        return ""
    said = ", ".join(
        f"{agent} {100 * share:.0f} %" for agent, share in ways.items() if share is not None
    )
    below = [agent for agent, values in finals.items() if min(values) <= levels["random"]]
    tail = (
        f"; a seed of {' and of '.join(below)} did not get above random"
        if below
        else ", every seed above random"
    )
    return f"{game} {TWIN_NAMES[twin]}, share of the way from random to oracle: {said}{tail}."


def _repeat(folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Commands, versions and settings; settings of a run where they differ from those that all runs
    share.
    """
    record = folder.record()
    here = {run.name: folder.run(run) for run in study.runs()}
    stated = {
        name: flatten(run.config)
        for name, run in here.items()
        if (run.path / "config.json").exists()
    }
    names = {key for run in stated.values() for key in run}
    default = {
        key: value for key, value in flatten(TrainConfig().to_dict()).items() if key in names
    }
    # one that is missing has its default
    settings = {name: default | run for name, run in stated.items()}
    first = next(iter(settings.values()), {})
    every = settings.values()
    shared = {
        key: value
        for key, value in first.items()
        if all(key in run and run[key] == value for run in every)
    }
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
