"""Build the report of a study: numbers first, then one page that holds everything."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.curves import agent_name, learning_curves
from arcade_torch.tools.analysis.gap_bias import GapBias, gap_and_bias
from arcade_torch.tools.analysis.references import cached_references
from arcade_torch.tools.extensions import command_line
from arcade_torch.tools.files import write_csv, write_text
from arcade_torch.tools.optional import need
from arcade_torch.tools.reports import sections, words
from arcade_torch.tools.reports.strips import Strip, saliency_strips
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study

TEMPLATES = Path(__file__).resolve().parent.parent / "templates"


def report(
    root: str | Path,
    out: str | Path | None = None,
    *,
    metric: str = "eval_final",
    saliency: bool = True,
    references: bool = True,
) -> Path:
    """Write the page of a study: one HTML file that loads nothing.

    Missing analyses are made on the way and kept in the study's folder under ``analysis``.

    Args:
        root: folder of the study.
        out: the page; ``report.html`` in the folder by default.
        metric: score of a run that headline and table rest on, ``eval_final`` or ``train_max_ewm``.
        saliency: whether to draw saliency strips.
        references: whether to draw the returns of the random policy and the oracles.

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
    if not any(row["status"] == "finished" for row in rows):
        raise ValueError(f"no run of {folder.root} has finished yet: nothing to report")
    levels = _levels(folder, study) if references else {}
    strips = saliency_strips(folder, study) if saliency else []
    context = page_context(folder, study, rows, levels, strips, metric)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["commas"] = lambda value: f"{int(value):,}"
    page = environment.get_template("report.html.j2").render(context)
    return write_text(Path(out) if out is not None else folder.root / "report.html", page)


def page_context(
    folder: StudyFolder,
    study: Study,
    rows: list[dict[str, Any]],
    levels: Mapping[str, Mapping[str, Mapping[str, float]]],
    strips: list[Strip],
    metric: str = "eval_final",
) -> dict[str, Any]:
    """Everything the template shows, computed from the files of a study."""
    table, trouble = _table(folder, study, metric)
    other = "train_max_ewm" if metric == "eval_final" else "eval_final"
    second, _ = _table(folder, study, other)
    agents = list(dict.fromkeys(agent_name(study, run) for run in study.runs()))
    colours = sections.colours(agents, study.baseline)
    finals = _finals(study, rows)
    record = folder.record()
    return {
        "study": study,
        "made": time.strftime("%Y-%m-%d %H:%M"),
        "headlines": _headlines(table, agents),
        "trouble": trouble,
        "learning": [words.learning_sentence(*key, finals[key], _means(levels, key[0])) for key in finals],
        "caution": words.coverage_sentence(table) if table else "",
        "unfinished": [row for row in rows if row["status"] != "finished"],
        "rows": rows,
        "finals": sections.final_rows(finals, levels),
        "levels": levels,
        "curves": sections.curve_panels(learning_curves(folder, study, "eval"), levels, colours),
        "train_curves": sections.curve_panels(learning_curves(folder, study, "train"), levels, colours),
        "table": table,
        "second": second,
        "whiskers": sections.whisker_panels(table, colours) if table else [],
        "strips": strips,
        "colours": colours,
        "runs": sections.run_details(folder, study, rows),
        "shared": sections.shared_settings(folder, study),
        "versions": record.get("versions", {}),
        "also": record.get("also", []),
        "command": record.get("command", ""),
        "report_command": command_line(["report", str(folder.root)]),
        "seconds": sum(float(row.get("seconds") or 0) for row in rows),
    }


def _table(folder: StudyFolder, study: Study, metric: str) -> tuple[GapBias | None, str]:
    """Gap and bias, also written as CSV; or why there is none."""
    baseline = study.baseline if len(study.algorithms) == 1 else f"{study.algorithms[0]}-{study.baseline}"
    try:
        table = gap_and_bias(folder.root, metric=metric, baseline=baseline)
    except ValueError as error:
        return None, str(error)
    rows = table.table()
    write_csv(folder.analysis / f"gap_bias_{metric}.csv", rows, list(rows[0]))
    return table, ""


def _headlines(table: GapBias | None, agents: list[str]) -> list[str]:
    if table is None:
        return []
    found = []
    for row in table.rows[1:]:
        found += [
            words.gap_sentence(table, row.agent),
            words.pomdp_sentence(table, row.agent),
            words.bias_sentence(row),
        ]
    return found


def _finals(study: Study, rows: list[dict[str, Any]]) -> dict[tuple[str, str], dict[str, list[float]]]:
    """(game, twin) -> agent -> final greedy returns of its finished seeds."""
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for run, row in zip(study.runs(), rows, strict=True):
        if row.get("eval_mean") is not None:
            task = found.setdefault((run.game, run.observability), {})
            task.setdefault(agent_name(study, run), []).append(float(row["eval_mean"]))
    return found


def _levels(folder: StudyFolder, study: Study) -> dict[str, dict[str, dict[str, float]]]:
    rules = str(study.settings.get("rules", "default"))
    return {game: cached_references(game, folder.analysis, rules=rules) for game in study.games}


def _means(levels: Mapping[str, Mapping[str, Mapping[str, float]]], game: str) -> dict[str, float]:
    return {kind: float(np.float64(value["mean"])) for kind, value in levels.get(game, {}).items()}
