"""Gap and Bias: one point an agent, also by size of the memory; bars of returns, Gap and Bias;
returns of people.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from arcade_torch.envs_jax.registry import DIFFICULTIES
from arcade_torch.tools.analysis.bootstrap import Interval, measured_coverage
from arcade_torch.tools.analysis.gap_bias import BOTH_TWINS, AgentRow, GapBias, gap_and_bias
from arcade_torch.tools.analysis.paper import PAPER_RETURNS, SEEDS, paper_table
from arcade_torch.tools.comparable import Runs, find_runs
from arcade_torch.tools.figures import (
    Made,
    PaperOptions,
    Picture,
    Progress,
    ScoreOptions,
    SweepOptions,
)
from arcade_torch.tools.figures.style import (
    MARKERS,
    NEUTRAL,
    TWIN_COLOURS,
    agent_colours,
    legend_name,
    panels,
    seeds_note,
    whiskers,
)
from arcade_torch.tools.files import Table, read_csv
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


def gap_bias(options: ScoreOptions, progress: Progress | None) -> Made:
    """The figure ``gap-bias``: right and down is better."""
    made, table, note = _table(options)
    figure, axes = panels(1, 1, (7.4, 5.4))
    plot(table.rows, axes[0, 0])
    made.pictures = [Picture("gap-bias", figure, note, table.table())]
    return made


def returns(options: ScoreOptions, progress: Progress | None) -> Made:
    """Two figures: ``returns`` and, with several games, ``returns-without`` (one game left out at a
    time).
    """
    made, table, note = _table(options)
    figure, axes = panels(1, 3, (12.5, 4.2))
    for axis, name in zip(axes[0], DRAWN, strict=True):
        plot_bars(table.rows, axis, name)
    made.pictures = [Picture("returns", figure, note, table.table())]
    if table.without:
        made.pictures.append(Picture("returns-without", _without_each(table), note))
    return made


def size_sweep(options: SweepOptions, progress: Progress | None) -> Made:
    """The figure ``size-sweep``: a panel a game; agents are named LAYERSxWIDTH, the memory-free one
    without.
    """
    found = find_runs(options.runs)
    sized = agent_names(found.names, sized=True)
    names = {
        key: name if memory_free(name, options.baseline) else sized[key]
        for key, name in found.names.items()
    }
    every = list(zip(found.runs, found.scores(options.metric), strict=True))
    notes = list(found.notes)
    tables = dict[str, GapBias]()
    for game in dict.fromkeys(run.game for run in found.runs):
        try:
            here = [
                replace(score, agent=names[run.key]) for run, score in every if run.game == game
            ]
            tables[game] = _computed(here, options)
        except ValueError as error:
            notes.append(f"left out, {game}: {error}")
    if not tables:
        raise ValueError(f"no size sweep in these runs: {notes[-1]}")
    rows = [row | {"game": game} for game, table in tables.items() for row in table.table()]
    if len({row["agent"] for row in rows}) < 3:
        notes.append(
            "a single size beside the memory-free agent: vary --network-option layers or "
            "hidden_size"
        )
    figure, axes = panels(1, len(tables), (7.2 * len(tables), 5.4))
    for axis, (game, table) in zip(axes[0], tables.items(), strict=True):
        plot(table.rows, axis)
        axis.set_title(game)
    note = f"labels: layers x width; {options.metric}, {_seeds(list(tables.values()), options)}"
    return Made([Picture("size-sweep", figure, note, rows)], notes)


def human(options: PaperOptions, progress: Progress | None) -> Made:
    """The figure ``human``; runs are not looked at."""
    table = read_csv(PAPER_RETURNS)
    people = [row for row in table if row["model"] == "human"]
    machine = {(row["env"], row["difficulty"]): row for row in table if row["model"] == "MLP"}
    figure, axes = panels(2, 5, (12.5, 5.6), sharey=True)
    x = np.arange(len(DIFFICULTIES))
    for axis, game in zip(axes.flat, dict.fromkeys(row["env"] for row in people), strict=True):
        here = [row for row in people if row["env"] == game]
        for side, (colour, twin) in enumerate(
            zip(TWIN_COLOURS.values(), ("mdp", "pomdp"), strict=True)
        ):
            places = x + (side - 0.5) * 0.36
            mean, std = ([float(row[f"{twin}_{what}"]) for row in here] for what in ("mean", "std"))
            style = {"fmt": "os"[side], "color": colour, "capsize": 2, "lw": 1.2}
            axis.errorbar(places, mean, std, label=f"people, {twin.upper()}", **style)
            plain = [float(machine[game, row["difficulty"]][f"{twin}_mean"]) for row in here]
            label = "memory-free agent" if side else None
            axis.plot(places, plain, "_", mew=2, color=agent_colours(["mlp"])["mlp"], label=label)
        axis.axhline(0.0, color="#bbbbbb", lw=0.8)
        axis.set_xticks(x, DIFFICULTIES)
        axis.set_title(game)
    for axis in axes[:, 0]:
        axis.set_ylabel("return, not normalised")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    note = f"published; n = {SEEDS} people, bars: one standard deviation over people"
    notes = ["people cannot be measured again: --runs is not looked at"] if options.runs else []
    return Made([Picture("human", figure, note, people)], notes)


def plot(rows: Sequence[AgentRow], axis: Any) -> None:
    """Draw a point an agent that has a Bias, with both intervals and the name beside it."""
    colours = agent_colours([row.agent for row in rows])
    for place, row in enumerate(filter(_has_bias, rows)):
        point = (row.bias.value, row.gap.value)
        colour = colours[row.agent]
        look = {"fmt": MARKERS[place % len(MARKERS)], "color": colour, "capsize": 2, "lw": 1}
        axis.errorbar(
            *point, *(whiskers(*np.array([each]).T) for each in (row.gap, row.bias)), **look
        )
        axis.annotate(
            row.agent, point, (6, 5), textcoords="offset points", color=colour, fontsize="small"
        )
    for line in (axis.axhline, axis.axvline):
        line(0.0, color=NEUTRAL, lw=1, ls="--")
    axis.margins(0.15)
    axis.grid(True, axis="both")
    axis.set_xlabel("Memory Bias\n(MDP - memory-free MDP, normalised return)")
    axis.set_ylabel("Observability Gap\n(MDP - POMDP, normalised return)")


def plot_bars(rows: Sequence[AgentRow], axis: Any, name: str) -> None:
    """Draw one number of every agent, one of `PANELS`, as a bar with its interval."""
    chosen = [row for row in rows if name != "bias" or _has_bias(row)]
    ends = np.reshape([getattr(row, name) for row in chosen], (-1, 3)).T
    places = range(len(chosen))
    colours = agent_colours([row.agent for row in rows])
    errors = {"error_kw": {"lw": 1}, "capsize": 3}
    axis.bar(
        places,
        ends[0],
        0.72,
        color=[colours[row.agent] for row in chosen],
        yerr=whiskers(*ends),
        **errors,
    )
    axis.set_xticks(
        places, [row.agent for row in chosen], rotation=35, ha="right", rotation_mode="anchor"
    )
    axis.set(title=PANELS[name][0], ylabel=PANELS[name][1])
    if name in ("gap", "bias"):
        axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")


def _without_each(table: GapBias) -> Any:
    """The same three numbers with one game left out at a time; the first column has all games."""
    columns = {"all games": table.rows} | {
        f"no {game}": rows for game, rows in table.without.items()
    }
    figure, axes = panels(3, 1, (12.5, 10), sharex=True)
    agents = [row.agent for row in table.rows]
    offsets = np.linspace(-0.34, 0.34, len(agents))
    places = np.arange(len(columns))
    for axis, name in zip(axes[:, 0], DRAWN, strict=True):
        for place, (agent, row) in enumerate(zip(agents, table.rows, strict=True)):
            if name == "bias" and (not _has_bias(row) or agent == table.baselines[agent]):
                continue
            ends = np.array([getattr(rows[place], name) for rows in columns.values()]).T
            look = {
                "fmt": MARKERS[place % len(MARKERS)],
                "lw": 1,
                "color": agent_colours(agents)[agent],
            }
            axis.errorbar(
                places + offsets[place], ends[0], whiskers(*ends), label=legend_name(agent), **look
            )
        axis.set_title(PANELS[name][0], loc="left")
        axis.set_ylabel(PANELS[name][1])
        axis.axvline(0.5, color=NEUTRAL, lw=0.8)
        if name != "pomdp":
            axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
    axes[0, 0].legend(ncols=len(agents), loc="lower center", bbox_to_anchor=(0.5, 1.08))
    axes[-1, 0].set_xticks(places, list(columns), rotation=25, ha="right")
    return figure


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
            "interval, tasks independent "
            "(bootstrap intervals of the gap would cover "
            f"{100 * measured_coverage(seeds, seeds):.0f} %)"
        )
        return Made(tables=[paper.printed()]), paper.table, note
    if not options.runs:
        raise ValueError("name at least one study folder, run folder or CSV file")
    folders = [path for path in options.runs if table_of(path) is None]
    found = find_runs(folders) if folders else Runs(())
    scores = read_scores(options.runs, options.metric)
    table = _computed(scores, options)
    notes = found.notes + found.single_seeds()
    rows = [
        row
        for path in options.runs
        if path not in folders
        for row in read_csv(table_of(path) or path)
    ]
    if lost := sum(row.get("status", "finished") != "finished" for row in rows):
        notes.append(f"left out, not finished: {lost} run{'s' * (lost > 1)}")
    if apart := sum(score.observability in BOTH_TWINS for score in scores):
        notes.append(
            f"left out, of no single twin: {apart} score{'s' * (apart > 1)} "
            f"({' or '.join(BOTH_TWINS)})"
        )
    if table.dropped:
        notes.append(f"left out, some agent lacks one of its twins: {', '.join(table.dropped)}")
    tasks = f"{len(table.tasks)} task{'s' * (len(table.tasks) > 1)}, {options.metric}"
    note = f"{tasks}, {_seeds([table], options)}"
    return Made(notes=notes, tables=[_printed(table, tasks)]), table, note


def _computed(scores: list[Score], options: SweepOptions) -> GapBias:
    how: Any = {
        name: getattr(options, name) for name in ("metric", "baseline", "draws", "confidence")
    }
    return gap_and_bias(scores, **how)


def _seeds(tables: Sequence[GapBias], options: SweepOptions) -> str:
    """How many seeds, and the smallest coverage of an interval of Gap."""
    share = min((share for table in tables for share in table.coverage.values()), default=None)
    return seeds_note(
        [row.seeds for table in tables for row in table.rows], options.confidence, share=share
    )


def _printed(table: GapBias, what: str) -> Table:
    """The table as it is printed; an interval stands under its value."""

    def cell(interval: Interval) -> str:
        ends = "" if np.isnan(interval.low) else f"\n{interval.low:+.3f} {interval.high:+.3f}"
        return "none" if np.isnan(interval.value) else f"{interval.value:+.3f}{ends}"

    head = {
        **{"mdp": "MDP", "pomdp": "POMDP", "gap": "gap", "bias": "bias", "mdp_iqm": "MDP IQM"},
        **{"pomdp_iqm": "POMDP IQM", "mdp_raw": "MDP raw", "pomdp_raw": "POMDP raw"},
    }
    rows = [
        (row.agent, row.seeds, *(cell(getattr(row, name)) for name in head)) for row in table.rows
    ]
    measured = ", ".join(
        f"{100 * share:.0f} % with {seeds} seeds" for seeds, share in table.coverage.items()
    )
    caption = (
        f"below: {100 * table.confidence:g} % bootstrap interval over seeds; measured coverage of "
        f"the gap's: {measured}"
        if measured
        else "no intervals: a single seed"
    )
    return Table(f"gap and bias over {what}", ("agent", "seeds", *head.values()), rows, caption)
