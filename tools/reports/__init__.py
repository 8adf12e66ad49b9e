"""Build the report of a study: numbers first, then one page that holds everything."""

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.comparable import Runs, check_comparable, import_notes
from arcade_torch.tools.errors import need
from arcade_torch.tools.exploring import stopped_exploring
from arcade_torch.tools.figures import Part, Progress
from arcade_torch.tools.figures.style import TWIN_NAMES, agent_colours, agents_by_task, drawing
from arcade_torch.tools.imports import import_again
from arcade_torch.tools.machine import torch_threads
from arcade_torch.tools.measures.beliefs import figure as beliefs
from arcade_torch.tools.measures.bootstrap import pooled
from arcade_torch.tools.measures.contamination import figure as contamination
from arcade_torch.tools.measures.counterfactual import figure as counterfactual
from arcade_torch.tools.measures.gap_bias import figure as gap_bias
from arcade_torch.tools.measures.gap_bias.measure import (
    GapBias,
    gap_and_bias,
    normalise,
    range_note,
)
from arcade_torch.tools.measures.recall_density import figure as recall_density
from arcade_torch.tools.measures.saliency import figure as saliency
from arcade_torch.tools.measures.section import Cells
from arcade_torch.tools.names import find_agent
from arcade_torch.tools.players import Baseline, references
from arcade_torch.tools.reports import panels
from arcade_torch.tools.reports.ahead import Piece, measure_ahead, measure_shard, pieces_of_runs
from arcade_torch.tools.reports.findings import (
    coverage_sentence,
    learning_sentence,
    score_sentences,
    way,
)
from arcade_torch.tools.reports.panels import Finals
from arcade_torch.tools.reports.repeating import how_to_repeat
from arcade_torch.tools.reports.subject import subject_section
from arcade_torch.tools.runs import Run, check_mean, open_run
from arcade_torch.tools.scores import METRICS
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study
from arcade_torch.tools.studies.shards import part_of

MANY_PANELS = 8  # from here on pictures of learning are small

Players = Mapping[str, Mapping[str, Baseline]]  # game -> player -> what it earned

# how the measures of a report are taken, for its text
_PROTOCOLS = {
    "twin_names": TWIN_NAMES,
    "density": recall_density.DENSITY,
    "bins": recall_density.BINS,
    "exchanges": counterfactual.EXCHANGES,
    "probes": beliefs.PROBES,
    "noise": contamination.NOISE,
    "powerless_below": contamination.POWERLESS_BELOW,
}


def report(
    root: str | Path,
    out: str | Path | None = None,
    *,
    metric: str = "eval_final",
    skip: Sequence[Part] = (),
    subject: str = "",
    workers: int = 1,
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
        skip: parts to leave out: saliency strips, recall density, counterfactual recall, beliefs,
            state contamination, returns of random policy and oracles.
        subject: the agent, or its memory, that the page is about; by default that of the study, if
            it has one.
        workers: processes that measure at once, 0 for one a core; with 1 this one measures all. The
            page is the same.
        progress: called with (what, done, total).

    Raises:
        FileNotFoundError: ``root`` is no study.
        ValueError: no run has finished yet, or there is no such part or subject.
        MissingPackage: jinja2 is not installed.
    """
    _check_options(metric, skip)
    environment = page_environment()
    folder = StudyFolder(Path(root))
    study = folder.load()
    rows = folder.write_results(study) if folder.is_writable else folder.rows(study)
    runs, about = _runs(folder, study, rows, subject)
    finals = _finals(runs)
    cells, note = panels.select_cells(runs, finals, study.baseline, about)
    if _is_on_cpu(runs):
        pieces = _pieces(folder, runs, cells, skip)
        measure_ahead(pieces, folder, _words(skip, subject), workers, progress)
    context: dict[str, Any] = {
        "study": study,
        "note": note,
        "changes": import_notes(runs.runs),
        "stopped": _stopped(runs),
        "written": time.strftime("%Y-%m-%d %H:%M"),
        "rows": rows,
        **_PROTOCOLS,
    }
    with drawing("light"), torch_threads(1):  # the last bits of a measure depend on how many
        players = _players(folder, runs, skip, progress)
        context |= _parts(runs, finals, cells, players, skip, progress)
        context |= _scores(folder, study, runs, metric, about)
    context["subject"] = _subject_part(folder, runs, about, metric, context["table"])
    context |= how_to_repeat(folder, study, rows)
    page = environment.get_template("report.html.j2").render(context)
    return write_atomic(Path(out) if out is not None else folder.root / "report.html", page)


def report_shard(
    root: str | Path, shard: str, *, skip: Sequence[Part] = (), subject: str = ""
) -> None:
    """Measure one share of what `report` measures, ``3/10`` for the third tenth, and keep it for
    the report; write no page. Everything else is as for `report`.
    """
    _check_options("eval_final", skip)
    part_of(shard)
    folder = StudyFolder(Path(root))
    study = folder.load()
    runs, about = _runs(folder, study, folder.rows(study), subject)
    cells, _ = panels.select_cells(runs, _finals(runs), study.baseline, about)
    with torch_threads(1):
        measure_shard(_pieces(folder, runs, cells, skip), shard)


def _runs(
    folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]], subject: str
) -> tuple[Runs, str]:
    """The runs that have finished, and the agent that the page is about, see `_subject`."""
    runs = _finished_runs(folder, study, rows)
    if not runs.runs:
        raise ValueError(f"no run of {folder.root} has finished yet: nothing to report")
    check_comparable(runs)
    return runs, _subject(study, runs, subject)


def _is_on_cpu(runs: Runs) -> bool:
    """Whether no agent is loaded onto a card, whose memory several processes would share."""
    return all(str(run.config.get("device", "cpu")) == "cpu" for run in runs.runs)


def _pieces(folder: StudyFolder, runs: Runs, cells: Cells, skip: Sequence[Part]) -> list[Piece]:
    """All that a report measures."""
    pieces = list[Piece]()
    if "references" not in skip:
        for game, run in _first_runs(runs).items():
            play = partial(_players_of, folder, run)
            pieces.append(Piece(game, play, folder.analysis, f"references-{game}-*.json"))
    return pieces + pieces_of_runs(cells, skip)


def _words(skip: Sequence[Part], subject: str) -> list[str]:
    """The options of the command line that decide what is measured."""
    words = ["--skip", *skip] if skip else []
    return [*words, "--subject", subject] if subject else words


def _check_options(metric: str, skip: Sequence[str]) -> None:
    """Refuse a metric or a part that there is not."""
    require(metric in METRICS, "metric", metric, f"one of {', '.join(METRICS)}")
    unknown = sorted(set(skip) - set(get_args(Part)))
    if unknown:
        raise ValueError(
            f"a report has no part {unknown[0]!r} to skip; parts: {', '.join(get_args(Part))}"
        )


def _subject_part(
    folder: StudyFolder, runs: Runs, about: str, metric: str, table: GapBias | None
) -> dict[str, Any] | None:
    """The subject beside every other agent, and the one that the headline holds it against; None
    without a subject.
    """
    if not about:
        return None
    rival = "" if table is None else table.baselines[about] or ""
    return subject_section(folder, runs, about, metric, rival)


def _subject(study: Study, runs: Runs, subject: str) -> str:
    """The agent that the page is about; empty if it is about all, or nothing is known of it yet."""
    memories = {run.key.memory for run in runs.runs}
    waits = study.subject in study.memories and study.subject not in memories
    if not subject and (not study.subject or waits):
        return ""
    return find_agent(runs.names, subject or study.subject)


def _stopped(runs: Runs) -> dict[str, str]:
    """The runs that stopped exploring before they learned, name -> one line on it."""
    lines = {run.path.name: stopped_exploring(run) for run in runs.runs}
    return {name: line for name, line in lines.items() if line}


def page_environment() -> Any:
    """What jinja2 renders the page with; a name that the template lacks is an error."""
    jinja2 = need("jinja2")
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("arcade_torch.tools"),
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["commas"] = "{:,}".format
    return environment


def _finished_runs(folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]]) -> Runs:
    """The runs of a study that have finished, as its rows of results say."""
    runs = []
    for spec, row in zip(study.runs(), rows, strict=True):
        if row["status"] == "finished":
            run = open_run(folder.run(spec).path)
            if run is not None:
                runs.append(run)
        elif row["status"] == "unfinished":
            check_mean(folder.run(spec).path)
    return Runs(tuple(runs))


def _parts(
    runs: Runs,
    finals: Finals,
    cells: Cells,
    players: Players,
    skip: Sequence[Part],
    progress: Progress | None,
) -> dict[str, Any]:
    """What the agents learned, and what a look into some of them shows."""
    agents = list(dict.fromkeys(runs.names[run.key] for run in runs.runs))
    parts = _learning(runs, finals, agents, players)
    parts["colours"] = {agent: f"c{place}" for place, agent in enumerate(agents)}
    parts["palette"] = list(agent_colours(agents).values())
    parts["strips"] = []
    parts["recall"] = None
    parts["counterfactual"] = None
    parts["beliefs"] = None
    parts["contamination"] = None
    if "saliency" not in skip:
        parts["strips"] = saliency.saliency_strips(cells, progress)
    with_recall = "recall" not in skip
    if with_recall:
        parts["recall"] = _unless_empty(recall_density.recall_section(cells, agents, progress))
    if "counterfactual" not in skip:
        section = counterfactual.counterfactual_section(cells, agents, progress, with_recall)
        parts["counterfactual"] = _unless_empty(section)
    parts["vanishing"] = _vanishing(parts["strips"], parts["counterfactual"])
    if "beliefs" not in skip:
        section = beliefs.beliefs_section(cells, agents, progress)
        parts["beliefs"] = _unless_empty(section)
    if "contamination" not in skip:
        section = contamination.contamination_section(cells, agents, progress)
        parts["contamination"] = _unless_empty(section)
    return parts


def _vanishing(
    strips: Sequence[Mapping[str, Any]], exchanges: Mapping[str, Any] | None
) -> list[str]:
    """The agents and tasks that have no gradient to speak of, in an episode or in many."""
    names = list[str]()
    for strip in strips:
        if strip["warning"]:
            names.append(f"{strip['agent']} on {strip['game']} {TWIN_NAMES[strip['twin']]}")
    for row in exchanges["rows"] if exchanges is not None else ():
        if row["saturated"]:
            names.append(f"{row['agent']} on {row['game']} {row['twin']}")
    return list(dict.fromkeys(names))


def _unless_empty(section: dict[str, Any]) -> dict[str, Any] | None:
    """A section, or None if it has nothing to show or to say."""
    return section if section["pictures"] or section["notes"] else None


def _finals(runs: Runs) -> Finals:
    """The final greedy returns of the seeds of every agent, by task."""
    returns = {}
    for cell, seeds in runs.groups().items():
        returns[cell] = [run.value("eval_final") for run in seeds]
    return agents_by_task(returns)


def _players(
    folder: StudyFolder, runs: Runs, skip: Sequence[Part], progress: Progress | None
) -> Players:
    """What the players earn under the rules and options that the study was trained with."""
    players = dict[str, Mapping[str, Baseline]]()
    if "references" in skip:
        return players
    first_runs = _first_runs(runs)
    for done, (game, run) in enumerate(first_runs.items(), start=1):
        players[game] = _players_of(folder, run)
        if progress is not None:
            progress("random policy and oracles", done, len(first_runs))
    return players


def _first_runs(runs: Runs) -> dict[str, Run]:
    """The first run of every game."""
    first_runs = dict[str, Run]()
    for run in runs.runs:
        first_runs.setdefault(run.game, run)
    return first_runs


def _players_of(folder: StudyFolder, run: Run) -> dict[str, Baseline]:
    """What the players earn in the game of a run."""
    import_again(run.path)  # of a game of the user's
    rules = str(run.config.get("rules", "default"))
    options = dict(run.config.get("env_options") or {})
    return references(run.game, folder.analysis, rules, options, imports=run.imports)


def _learning(
    runs: Runs, finals: Finals, agents: Sequence[str], players: Players
) -> dict[str, Any]:
    """Curves, and the final greedy returns as sentences, rows and overviews."""
    levels = dict[str, dict[str, float]]()
    for game, baselines in players.items():
        levels[game] = {player: baseline.mean for player, baseline in baselines.items()}
    sentences = list[str]()
    rows = list[dict[str, Any]]()
    overviews = dict[str, list[dict[str, Any]]]()
    for (game, twin), by_agent in finals.items():
        level = levels.get(game, {})
        sentence = learning_sentence(game, twin, by_agent, level)
        if sentence:
            sentences.append(sentence)
        task = {"game": game, "twin": TWIN_NAMES[twin], "task": f"{game}-{twin}"}
        cells: dict[str, Any] = dict.fromkeys(agents)
        for agent, returns in by_agent.items():
            row = _final_row(agent, returns, level)
            rows.append(task | row)
            share = min(1.0, max(0.0, normalise(game, row["mean"])))
            cells[agent] = {"value": row["mean"], "heat": round(100 * share)}
        overviews.setdefault(TWIN_NAMES[twin], []).append(task | {"cells": cells})
    small = len(finals) > MANY_PANELS
    train_curves = [] if small else panels.curve_panels(runs, "train", levels, agents, small)
    return {
        "learning": sentences,
        "small": small,
        "curves": panels.curve_panels(runs, "eval", levels, agents, small),
        "train_curves": train_curves,
        "finals": rows,
        "overviews": overviews,
        "players": players,
    }


def _final_row(agent: str, returns: Sequence[float], levels: Mapping[str, float]) -> dict[str, Any]:
    """The final returns of one agent on one task, for the table; without a mean if one of them is
    no number.
    """
    mean = low = high = math.nan
    if all(map(math.isfinite, returns)):
        summary = pooled(returns)
        mean = float(summary.mean)
        low = float(summary.low)
        high = float(summary.high)
    return {
        "agent": agent,
        "mean": mean,
        "low": low,
        "high": high,
        "way": way(mean, levels),
        "seeds": "  ".join(f"{value:.3f}" for value in returns),
    }


def _scores(
    folder: StudyFolder, study: Study, runs: Runs, metric: str, subject: str
) -> dict[str, Any]:
    """Gap and bias by both metrics, also written as CSV, and what they say; or why there are
    none.
    """
    tables = dict[str, GapBias]()
    trouble = ""
    wide = ""
    for name in sorted(METRICS, key=lambda name: name != metric):
        try:
            scores = runs.scores(name)
            wide = wide or range_note(scores, sorted({score.game for score in scores}))
            tables[name] = gap_and_bias(scores, metric=name, baseline=study.baseline)
            folder.keep_table(f"gap_bias_{name}.csv", tables[name].table())
        except ValueError as error:
            trouble = trouble or str(error)
    table = tables.get(metric)
    if table is not None:
        trouble = table.trouble
    second = [tables[name] for name in tables if name != metric]
    return {
        "trouble": trouble,
        "wide": wide,
        "table": table,
        "second": second[0] if second else None,
        "sentences": score_sentences(table, subject) if table is not None else [],
        "score_panels": gap_bias.score_panels(table) if table is not None else [],
        "caution": coverage_sentence(table) if table is not None else "",
    }
