"""Build the report of a study: numbers first, then one page that holds everything."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
from arcade_torch.tools.reports.chosen import Cell, chosen_cells
from arcade_torch.tools.reports.memory import (
    BINS,
    DENSITY,
    NOISE,
    MemorySection,
    contamination_section,
    recall_section,
)
from arcade_torch.tools.reports.strips import Strip, saliency_strips
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study

TEMPLATES = Path(__file__).resolve().parent.parent / "templates"


MANY_PANELS = 8
"""From here on learning curves are small multiples with one legend."""

MANY_ROWS = 24
"""From here on long tables are folded away behind a short one."""

MANY_RUNS = 48
"""From here on the runs stand in one table, without their commands."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Inside:
    """What was found inside the agents: cells looked into, why not others, and the sections made from them."""

    cells: list[Cell]
    note: str = ""
    strips: list[Strip] = field(default_factory=list)
    recall: MemorySection | None = None
    contamination: MemorySection | None = None


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
    if not any(row["status"] == "finished" for row in rows):
        raise ValueError(f"no run of {folder.root} has finished yet: nothing to report")
    levels = _levels(folder, study, progress) if references else {}
    cells, note = chosen_cells(folder, study, rows, _finals(study, rows))
    colour = sections.colours(_agents(study), study.baseline)
    inside = Inside(
        cells,
        note,
        saliency_strips(folder, cells, progress) if saliency else [],
        recall_section(cells, colour, progress) if recall else None,
        contamination_section(cells, colour, progress) if contamination else None,
    )
    context = page_context(folder, study, rows, levels, inside, metric)
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


def page_context(
    folder: StudyFolder,
    study: Study,
    rows: list[dict[str, Any]],
    levels: Mapping[str, Mapping[str, Mapping[str, float]]],
    inside: Inside,
    metric: str = "eval_final",
) -> dict[str, Any]:
    """Everything the template shows, computed from the files of a study."""
    table, trouble = _table(folder, study, metric)
    second, _ = _table(folder, study, "train_max_ewm" if metric == "eval_final" else "eval_final")
    agents = _agents(study)
    colours = sections.colours(agents, study.baseline)
    finals = _finals(study, rows)
    record = folder.record()
    settings = sections.all_settings(folder, study)
    shared = sections.shared_settings(settings)
    small = len(finals) > MANY_PANELS
    learning = [words.learning_sentence(*key, finals[key], _means(levels, key[0])) for key in finals]
    headlines = _headlines(table)
    return {
        "study": study,
        "made": time.strftime("%Y-%m-%d %H:%M"),
        "headlines": headlines[:3],
        "more": headlines[3:],
        "trouble": trouble,
        "learning": [sentence for sentence in learning if sentence],
        "caution": words.coverage_sentence(table) if table else "",
        "unfinished": [row for row in rows if row["status"] != "finished"],
        "rows": rows,
        "finals": sections.final_rows(finals, levels),
        "overviews": sections.overviews(finals, agents) if len(study.games) > 2 else [],
        "levels": levels,
        "small": small,
        "curves": sections.curve_panels(learning_curves(folder, study, "eval"), levels, colours, small),
        "train_curves": []
        if small
        else sections.curve_panels(learning_curves(folder, study, "train"), levels, colours),
        "table": table,
        "second": second,
        "whiskers": sections.whisker_panels(table, colours) if table else [],
        "inside": inside,
        "looked": {f"{cell.game}-{cell.twin}" for cell in inside.cells} if inside.strips else set(),
        "density": DENSITY,
        "noise": NOISE,
        "bins": BINS,
        "colours": colours,
        "palette": sections.PALETTE,
        "runs": sections.run_details(folder, study, rows, settings, shared),
        "shared": shared,
        "many_rows": MANY_ROWS,
        "many_runs": MANY_RUNS,
        "versions": record.get("versions", {}),
        "also": record.get("also", []),
        "command": record.get("command", ""),
        "report_command": command_line(["report", str(folder.root)]),
        "seconds": sum(float(row.get("seconds") or 0) for row in rows),
    }


def _agents(study: Study) -> list[str]:
    return list(dict.fromkeys(agent_name(study, run) for run in study.runs()))


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


def _headlines(table: GapBias | None) -> list[str]:
    """Three sentences on each agent with memory; the one with the highest POMDP return first."""
    if table is None:
        return []
    found = []
    for row in sorted(table.rows[1:], key=lambda row: -row.pomdp.value):
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


def _levels(folder: StudyFolder, study: Study, progress: Progress | None) -> dict[str, dict[str, dict[str, float]]]:
    rules = str(study.settings.get("rules", "default"))
    found = {}
    for done, game in enumerate(study.games, start=1):
        found[game] = cached_references(game, folder.analysis, rules=rules)
        if progress is not None:
            progress("random policy and oracles", done, len(study.games))
    return found


def _means(levels: Mapping[str, Mapping[str, Mapping[str, float]]], game: str) -> dict[str, float]:
    return {kind: float(np.float64(value["mean"])) for kind, value in levels.get(game, {}).items()}
