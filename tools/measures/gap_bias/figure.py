"""Gap and Bias: one point an agent, also by size of the memory; bars of returns, Gap and Bias;
returns of people.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.envs_jax.registry import DIFFICULTIES
from arcade_torch.tools.comparable import Runs, find_runs
from arcade_torch.tools.figures import Made, PaperOptions, Picture, Progress, style
from arcade_torch.tools.figures.style import (
    NEUTRAL,
    TWIN_COLOURS,
    agent_colours,
    agent_markers,
    legend_above,
    legend_name,
    panels,
    seeds_note,
    whiskers,
)
from arcade_torch.tools.files import Table
from arcade_torch.tools.measures.bootstrap import Interval, measured_coverage
from arcade_torch.tools.measures.gap_bias import ScoreOptions, SweepOptions
from arcade_torch.tools.measures.gap_bias.measure import (
    BOTH_TWINS,
    AgentRow,
    GapBias,
    gap_and_bias,
    range_notes,
)
from arcade_torch.tools.measures.gap_bias.numbered import name_points, number_points
from arcade_torch.tools.measures.gap_bias.paper import PAPER_RETURNS, SEEDS, paper_table
from arcade_torch.tools.names import agent_names, memory_free
from arcade_torch.tools.runs import Score
from arcade_torch.tools.scores import read_scores, table_of

PANELS = {
    "mdp": ("MDP return", "normalised return"),
    "pomdp": ("POMDP return", "normalised return"),
    "gap": ("Observability Gap", "MDP - POMDP"),
    "bias": ("Memory Bias", "MDP - memory-free MDP"),
}
DRAWN = ("pomdp", "gap", "bias")
COLUMNS = {
    "mdp": "MDP",
    "pomdp": "POMDP",
    "gap": "gap",
    "bias": "bias",
    "mdp_iqm": "MDP IQM",
    "pomdp_iqm": "POMDP IQM",
    "mdp_raw": "MDP raw",
    "pomdp_raw": "POMDP raw",
}
"""Numbers of the printed table, and their heads."""
LEAST_SPAN = 0.02
"""Of an axis of Gap or Bias."""
MOST_NAMED = 8
"""Agents whose names stand at their points."""
MOST_BESIDE = 12
"""Agents whose bars go into panels side by side; more get the whole width."""
LINE = 0.16
"""Inches of an agent's line where there are more in a panel."""


def gap_bias(options: ScoreOptions, progress: Progress | None) -> Made:
    """The figure ``gap-bias``: right and down is better; without any Bias, the gaps alone."""
    result, table, note = _table(options)
    figure, axes = panels(1, 1, (7.4, 5.4))
    if table.baseline:
        plot(table.rows, axes[0, 0])
    else:
        plot_bars(table.rows, axes[0, 0], "gap")
    result.pictures = [Picture("gap-bias", figure, note, table.table())]
    return result


def returns(options: ScoreOptions, progress: Progress | None) -> Made:
    """Two figures: ``returns`` and, with several games, ``returns-without`` (one game left out at a
    time).
    """
    result, table, note = _table(options)
    table.check_bias()
    agents = len(table.rows)
    if agents <= MOST_BESIDE:
        figure, axes = panels(1, 3, (12.5, 4.2))
    else:
        figure, axes = panels(3, 1, (1.5 + 0.3 * agents, 11))
    for axis, name in zip(axes.flat, DRAWN, strict=True):
        plot_bars(table.rows, axis, name)
    result.pictures = [Picture("returns", figure, note, table.table())]
    if table.without:
        result.pictures.append(Picture("returns-without", _without_each(table), note))
    return result


def size_sweep(options: SweepOptions, progress: Progress | None) -> Made:
    """The figure ``size-sweep``: a panel a game; agents are named LAYERSxWIDTH, the memory-free one
    without.
    """
    runs = find_runs(options.runs)
    notes = list(runs.notes)
    tables = dict[str, GapBias]()
    for game, scores in _scores_by_game(runs, options).items():
        try:
            table = _computed(scores, options)
            table.check_bias()
            tables[game] = table
        except ValueError as error:
            notes.append(f"left out, {game}: {error}")
    if not tables:
        raise ValueError(f"no size sweep in these runs: {notes[-1]}")
    figure, axes = panels(1, len(tables), (7.2 * len(tables), 5.4))
    rows = list[dict[str, Any]]()
    agents = set[str]()
    for axis, (game, table) in zip(axes[0], tables.items(), strict=True):
        plot(table.rows, axis)
        axis.set_title(game)
        for row in table.table():
            rows.append(row | {"game": game})
            agents.add(row["agent"])
    if len(agents) < 3:
        notes.append(
            "a single size beside the memory-free agent: vary --network-option layers or "
            "hidden_size"
        )
    note = f"labels: layers x width; {options.metric}, {_seeds(list(tables.values()), options)}"
    return Made([Picture("size-sweep", figure, note, rows)], notes)


def _scores_by_game(runs: Runs, options: SweepOptions) -> dict[str, list[Score]]:
    """The scores of runs by game; agents with memory are named by its size."""
    names = dict(runs.names)
    sized = agent_names(names, sized=True)
    for key, name in runs.names.items():
        if not memory_free(name, options.baseline):
            names[key] = sized[key]
    by_game: dict[str, list[Score]] = {}
    for run, score in zip(runs.runs, runs.scores(options.metric), strict=True):
        by_game.setdefault(run.game, []).append(replace(score, agent=names[run.key]))
    return by_game


def human(options: PaperOptions, progress: Progress | None) -> Made:
    """The figure ``human``; runs are not looked at."""
    people: dict[str, list[dict[str, str]]] = {}
    rows_without_memory: dict[str, list[dict[str, str]]] = {}
    rows = []
    for row in read_csv(PAPER_RETURNS):
        if row["model"] == "human":
            people.setdefault(row["env"], []).append(row)
            rows.append(row)
        elif row["model"] == "MLP":
            rows_without_memory.setdefault(row["env"], []).append(row)
    figure, axes = panels(2, 5, (12.5, 5.6), sharey=True)
    for axis, game in zip(axes.flat, people, strict=True):
        _plot_people(people[game], rows_without_memory[game], axis)
        axis.set_title(game)
    for axis in axes[:, 0]:
        axis.set_ylabel("return, not normalised")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    note = f"published; n = {SEEDS} people, bars: one standard deviation over people"
    notes = ["people cannot be measured again: --runs is not looked at"] if options.runs else []
    return Made([Picture("human", figure, note, rows)], notes)


def _plot_people(
    people: Sequence[Mapping[str, str]], without_memory: Sequence[Mapping[str, str]], axis: Any
) -> None:
    """Draw the returns of people in one game by difficulty, those of the memory-free agent beside
    them.
    """
    x = np.arange(len(DIFFICULTIES))
    grey = agent_colours(["mlp"])["mlp"]
    baseline = {row["difficulty"]: row for row in without_memory}
    sides = (("mdp", "full", "o", -0.18), ("pomdp", "partial", "s", 0.18))
    for name, twin, marker, offset in sides:
        means = [float(row[f"{name}_mean"]) for row in people]
        stds = [float(row[f"{name}_std"]) for row in people]
        axis.errorbar(
            x + offset,
            means,
            stds,
            label=f"people, {name.upper()}",
            fmt=marker,
            color=TWIN_COLOURS[twin],
            capsize=2,
            lw=1.2,
        )
        levels = [float(baseline[row["difficulty"]][f"{name}_mean"]) for row in people]
        label = "memory-free agent" if name == "pomdp" else None
        axis.plot(x + offset, levels, "_", mew=2, color=grey, label=label)
    axis.axhline(0.0, color="#bbbbbb", lw=0.8)
    axis.set_xticks(x, DIFFICULTIES)


def plot(rows: Sequence[AgentRow], axis: Any) -> None:
    """Draw a point an agent that has a Bias, with both intervals and the name beside it; of many
    agents a number, and the names in a legend beside the panel.
    """
    colours = agent_colours([row.agent for row in rows])
    drawn = list(filter(_has_bias, rows))
    markers = agent_markers([row.agent for row in drawn], colours)
    bars = list[Any]()
    for row in drawn:
        point = (row.bias.value, row.gap.value)
        look = {"fmt": markers[row.agent], "color": colours[row.agent], "capsize": 2, "lw": 1}
        whiskers_of = {"yerr": _whiskers([row.gap]), "xerr": _whiskers([row.bias])}
        bars.append(axis.errorbar(*point, **whiskers_of, **look))
    for line in (axis.axhline, axis.axvline):
        line(0.0, color=NEUTRAL, lw=1, ls="--")
    axis.margins(0.15)
    _widen(axis)
    write_names = number_points if len(drawn) > MOST_NAMED else name_points
    write_names(axis, bars, [row.agent for row in drawn])
    axis.grid(True, axis="both")
    axis.set_xlabel("Memory Bias\n(MDP - memory-free MDP, normalised return)")
    axis.set_ylabel("Observability Gap\n(MDP - POMDP, normalised return)")


def _widen(axis: Any) -> None:
    """Give both axes `LEAST_SPAN`, so that rounding errors do not look like gaps."""
    for limits, change in ((axis.get_xlim(), axis.set_xlim), (axis.get_ylim(), axis.set_ylim)):
        lacking = max(0.0, LEAST_SPAN - (limits[1] - limits[0]))
        change(limits[0] - lacking / 2, limits[1] + lacking / 2)


def plot_bars(rows: Sequence[AgentRow], axis: Any, name: str) -> None:
    """Draw one number of every agent, one of `PANELS`, as a bar with its interval."""
    agents, intervals, look = _numbers(rows, name)
    places = range(len(agents))
    values = [interval.value for interval in intervals]
    axis.bar(places, values, 0.72, yerr=_whiskers(intervals), capsize=3, **look)
    turn = 35 if len(agents) <= MOST_BESIDE else 60
    labels = list(map(style.folded, agents))
    axis.set_xticks(places, labels, rotation=turn, ha="right", rotation_mode="anchor")
    axis.set(title=PANELS[name][0], ylabel=PANELS[name][1])
    if name in ("gap", "bias"):
        axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")


def plot_lines(rows: Sequence[AgentRow], axis: Any, name: str) -> None:
    """The same of many agents in a narrow panel: a line each, with its interval."""
    agents, intervals, look = _numbers(rows, name)
    places = range(len(agents))
    values = [interval.value for interval in intervals]
    axis.barh(places, values, 0.72, xerr=_whiskers(intervals), **look)
    axis.set_yticks(places, map(style.folded, agents), fontsize=8)
    axis.set_ylim(len(agents) - 0.5, -0.5)
    axis.set(title=PANELS[name][0], xlabel=PANELS[name][1])
    axis.axvline(0.0, color=NEUTRAL, lw=1)
    axis.grid(visible=False)
    axis.grid(visible=True, axis="x")


def _numbers(
    rows: Sequence[AgentRow], name: str
) -> tuple[list[str], list[Interval], dict[str, Any]]:
    """The agents that have a number, its intervals, and how bars look: one of 0 is a line."""
    colours = agent_colours([row.agent for row in rows])
    with_number = list(filter(_has_bias, rows)) if name == "bias" else rows
    agents = [row.agent for row in with_number]
    intervals = [getattr(row, name) for row in with_number]
    drawn = [colours[agent] for agent in agents]
    return agents, intervals, {"color": drawn, "edgecolor": drawn, "error_kw": {"lw": 1}}


def _whiskers(intervals: Sequence[Interval]) -> Any:
    """Lengths of the error bars of intervals, [2, n]."""
    return whiskers(*np.reshape(intervals, (-1, 3)).T)


def _without_each(table: GapBias) -> Any:
    """The same three numbers with one game left out at a time; the first column has all games."""
    columns = {"all games": table.rows}
    for game, rows in table.without.items():
        columns[f"no {game}"] = rows
    figure, axes = panels(3, 1, (12.5, 10), sharex=True)
    for axis, name in zip(axes[:, 0], DRAWN, strict=True):
        _plot_columns(list(columns.values()), table, axis, name)
    legend_above(figure, axes[0, 0].get_legend_handles_labels()[0])
    axes[-1, 0].set_xticks(range(len(columns)), list(columns), rotation=25, ha="right")
    return figure


def _plot_columns(
    columns: Sequence[Sequence[AgentRow]], table: GapBias, axis: Any, name: str
) -> None:
    """Draw one number of every agent, one of `PANELS`, in several columns side by side."""
    agents = [row.agent for row in table.rows]
    colours = agent_colours(agents)
    markers = agent_markers(agents, colours)
    places = np.arange(len(columns))
    offsets = np.linspace(-0.34, 0.34, len(agents))
    for index, row in enumerate(table.rows):
        is_baseline = row.agent == table.baselines[row.agent]
        if name == "bias" and (is_baseline or not _has_bias(row)):
            continue
        intervals = [getattr(rows[index], name) for rows in columns]
        axis.errorbar(
            places + offsets[index],
            [interval.value for interval in intervals],
            _whiskers(intervals),
            label=legend_name(row.agent),
            fmt=markers[row.agent],
            color=colours[row.agent],
            lw=1,
        )
    axis.set_title(PANELS[name][0], loc="left")
    axis.set_ylabel(PANELS[name][1])
    axis.axvline(0.5, color=NEUTRAL, lw=0.8)
    if name != "pomdp":
        axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")


def _has_bias(row: AgentRow) -> bool:
    """Whether Bias, which compares runs of one algorithm, is known of a row: not of people."""
    return row.agent.lower() != "human" and not np.isnan(row.bias.value)


def _table(options: ScoreOptions) -> tuple[Made, GapBias, str]:
    """The table of runs, of CSV files, or of the paper; what to say and print; what stands under a
    figure of it.
    """
    if options.paper:
        paper = paper_table()
        seeds = (SEEDS,) * len(paper.table.tasks)
        note = (
            f"published returns, {len(seeds)} tasks, n = {SEEDS} seeds; bars: normal 95 % "
            "interval, tasks independent (bootstrap intervals of the gap would cover "
            f"{100 * measured_coverage(seeds, seeds):.0f} %)"
        )
        return Made(tables=[paper.printed()]), paper.table, note
    if not options.runs:
        raise ValueError("name at least one study folder, run folder or CSV file")
    folders = [path for path in options.runs if table_of(path) is None]
    runs = find_runs(folders) if folders else Runs(())
    scores = read_scores(options.runs, options.metric)
    table = _computed(scores, options)
    notes = runs.notes + runs.single_seeds()
    unfinished = sum(_count_unfinished(path) for path in options.runs if path not in folders)
    if unfinished:
        notes.append(f"left out, not finished: {unfinished} run{'s' * (unfinished > 1)}")
    twins = Counter(score.observability for score in scores)
    mixed = sum(twins[twin] for twin in BOTH_TWINS)
    if mixed:
        notes.append(
            f"left out, of no single twin: {mixed} score{'s' * (mixed > 1)} "
            f"({' or '.join(BOTH_TWINS)})"
        )
    if table.trouble:
        notes.append(table.trouble)
    if table.dropped:
        notes.append(f"left out, some agent lacks one of its twins: {', '.join(table.dropped)}")
    notes += range_notes(scores, table.tasks)
    tasks = f"{len(table.tasks)} task{'s' * (len(table.tasks) > 1)}, {options.metric}"
    note = f"{tasks}, {_seeds([table], options)}"
    return Made(notes=notes, tables=[_printed(table, tasks)]), table, note


def _count_unfinished(path: Path) -> int:
    """The number of rows of a table of runs, or of a study's, that have not finished."""
    statuses = Counter(row.get("status", "finished") for row in read_csv(table_of(path) or path))
    return statuses.total() - statuses["finished"]


def _computed(scores: list[Score], options: SweepOptions) -> GapBias:
    """The table of Gap and Bias with the options of a figure."""
    return gap_and_bias(
        scores,
        metric=options.metric,
        baseline=options.baseline,
        draws=options.draws,
        confidence=options.confidence,
    )


def _seeds(tables: Sequence[GapBias], options: SweepOptions) -> str:
    """How many seeds, and the smallest coverage of an interval of Gap."""
    seeds = list[int]()
    shares = list[float]()
    for table in tables:
        seeds += [row.seeds for row in table.rows]
        shares += table.coverage.values()
    return seeds_note(seeds, options.confidence, share=min(shares, default=None))


def _printed(table: GapBias, title: str) -> Table:
    """The table as it is printed; an interval stands under its value."""

    rows = list[tuple[Any, ...]]()
    for row in table.rows:
        cells = [_cell(getattr(row, name)) for name in COLUMNS]
        rows.append((row.agent, row.seeds, *cells))
    shares = [f"{100 * share:.0f} % with {seeds} seeds" for seeds, share in table.coverage.items()]
    if shares:
        caption = (
            f"below: {100 * table.confidence:g} % bootstrap interval over seeds; measured coverage "
            f"of the gap's: {', '.join(shares)}"
        )
    else:
        caption = "no intervals: a single seed"
    return Table(f"gap and bias over {title}", ("agent", "seeds", *COLUMNS.values()), rows, caption)


def _cell(interval: Interval) -> str:
    """A number, and under it its interval if it has one."""
    if np.isnan(interval.value):
        return "none"
    if np.isnan(interval.low):
        return f"{interval.value:+.3f}"
    return f"{interval.value:+.3f}\n{interval.low:+.3f} {interval.high:+.3f}"


def score_panels(table: GapBias) -> list[str]:
    """Pictures of normalised returns on both twins, Gap and Bias; no Bias where there are only
    memory-free agents.
    """
    pictures = []
    for name in PANELS:
        rows = [row for row in table.rows if row.agent != table.baselines[row.agent]]
        if name == "bias" and not any(map(_has_bias, rows)):
            continue
        lines = max(style.folded(row.agent).count("\n") + 1 for row in table.rows)
        if len(table.rows) <= MOST_BESIDE and lines == 1:
            figure, axes = panels(1, 1, style.PANEL)
            plot_bars(table.rows, axes[0, 0], name)
        else:
            height = max(style.PANEL[1], 1 + LINE * lines * len(table.rows))
            figure, axes = panels(1, 1, (style.PANEL[0], height))
            plot_lines(table.rows, axes[0, 0], name)
        pictures.append(style.svg(figure, name))
    return pictures
