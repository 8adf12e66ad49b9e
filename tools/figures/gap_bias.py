"""Gap against Bias: one point an agent; right and down is better. Also the table that returns and report draw."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Interval, seed_coverage
from arcade_torch.tools.analysis.gap_bias import AgentRow, GapBias, gap_and_bias
from arcade_torch.tools.analysis.paper import SEEDS, paper_table
from arcade_torch.tools.figures.registry import Made, Progress, ScoreOptions
from arcade_torch.tools.figures.style import (
    MARKERS,
    NEUTRAL,
    agent_colours,
    drawing,
    footnote,
    inches,
    save,
    seeds_note,
    whiskers,
)
from arcade_torch.tools.runs import Score, find_runs, read_scores
from arcade_torch.tools.tables import Table

Options = ScoreOptions


def make(options: ScoreOptions, progress: Progress | None) -> Made:
    """The figure ``gap-bias``."""
    made, table, under = table_of(options)
    with drawing(options.style) as plt:
        figure, axis = plt.subplots(figsize=inches(options.style, 7.4, 5.4), layout="constrained")
        plot(table.rows, axis)
        footnote(figure, under)
        made.files += save(options, "gap-bias", figure, made.rows)
    return made


def plot(rows: Sequence[AgentRow], axis: Any) -> None:
    """Draw a point an agent, with both intervals and the name beside it; people have no Bias."""
    colours = agent_colours([row.agent for row in rows])
    for place, row in enumerate(row for row in rows if not is_person(row.agent)):
        ends = np.array([[x.low, x.value, x.high] for x in (row.bias, row.gap)])
        colour = colours[row.agent]
        xerr, yerr = (whiskers(*line[:, None]) if np.isfinite(line).all() else None for line in ends)
        mark, point = MARKERS[place % len(MARKERS)], (row.bias.value, row.gap.value)
        axis.errorbar(*point, yerr=yerr, xerr=xerr, fmt=mark, color=colour, capsize=2, lw=1)
        axis.annotate(row.agent, point, (6, 5), textcoords="offset points", color=colour, fontsize="small")
    axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
    axis.axvline(0.0, color=NEUTRAL, lw=1, ls="--")
    axis.margins(0.15)
    axis.grid(True, axis="both")
    axis.set_xlabel("Memory Bias\n(MDP - memory-free MDP, normalised return)")
    axis.set_ylabel("Observability Gap\n(MDP - POMDP, normalised return)")


def is_person(agent: str) -> bool:
    """Whether a row is people: they have no Bias, which compares training runs."""
    return agent.lower() == "human"


def table_of(options: ScoreOptions) -> tuple[Made, GapBias, str]:
    """The table of runs, of CSV files, or of the paper."""
    if options.paper:
        paper = paper_table()
        under = (
            f"published returns, {len(paper.table.tasks)} tasks, n = {SEEDS} seeds; bars: normal 95 % interval, tasks "
            f"independent (a bootstrap over {SEEDS} seeds would cover {100 * seed_coverage(SEEDS):.0f} %)"
        )
        return Made([], [paper.text()], rows=paper.table.table()), paper.table, under
    scores, notes = _scores(options)
    table = gap_and_bias(
        scores, metric=options.metric, baseline=options.baseline, draws=options.draws, confidence=options.confidence
    )
    if table.dropped:
        notes.append(f"left out, some agent lacks one of its twins: {', '.join(table.dropped)}")
    tasks = f"{len(table.tasks)} task{'s' * (len(table.tasks) > 1)}, {options.metric}"
    under = f"{tasks}, {seeds_note([row.seeds for row in table.rows], options.confidence)}"
    return Made([], notes, [printed(table, tasks)], table.table()), table, under


def _scores(options: ScoreOptions) -> tuple[list[Score], list[str]]:
    """Scores of tables, and of the finished runs below folders."""
    if not options.runs:
        raise ValueError("name at least one study folder, run folder or CSV file")
    known = [path for path in options.runs if path.is_file() or _is_bare(path)]
    if len(known) == len(options.runs):
        return read_scores(known, options.metric), []
    found = find_runs([path for path in options.runs if path not in known])
    notes = found.notes + found.single_seeds()
    if not known:
        return found.scores(options.metric), notes
    return read_scores([*known, *(run.path for run in found.runs)], options.metric), notes


def _is_bare(path: Path) -> bool:
    """Whether a study's folder has lost its runs but not its table."""
    return (path / "results.csv").is_file() and next(path.rglob("config.json"), None) is None


def printed(table: GapBias, what: str) -> Table:
    """The table as it is printed; an interval stands under its value."""

    def cell(interval: Interval) -> str:
        ends = "" if np.isnan(interval.low) else f"\n{interval.low:+.3f} {interval.high:+.3f}"
        return f"{interval.value:+.3f}{ends}"

    names: Mapping[str, str] = {"mdp": "MDP", "pomdp": "POMDP", "gap": "gap", "bias": "bias"}
    names |= {"mdp_iqm": "MDP IQM", "pomdp_iqm": "POMDP IQM", "mdp_raw": "MDP raw", "pomdp_raw": "POMDP raw"}  # type: ignore[operator]
    rows = [(row.agent, row.seeds, *(cell(getattr(row, name)) for name in names)) for row in table.rows]
    coverage = {row.seeds: row.coverage for row in table.rows if row.coverage == row.coverage}
    measured = ", ".join(f"{100 * share:.0f} % with {seeds} seeds" for seeds, share in sorted(coverage.items()))
    caption = (
        f"below: {100 * table.confidence:g} % bootstrap interval over seeds; measured coverage of the gap's: {measured}"
        if measured
        else "no intervals: a single seed"
    )
    return Table(f"gap and bias over {what}", ("agent", "seeds", *names.values()), rows, caption)
