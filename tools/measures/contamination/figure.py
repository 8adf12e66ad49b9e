"""State contamination: flip rate and relative change by delay, with intervals over seeds; and
single examples.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from arcade_torch.agents.checked import require
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import Made, Picture, Progress, style
from arcade_torch.tools.files import Table
from arcade_torch.tools.measures.arguments import check_by_name
from arcade_torch.tools.measures.bootstrap import Pooled, pooled
from arcade_torch.tools.measures.checkpoints import (
    Label,
    by_task,
    checkpoints_of,
    measure_run,
    measure_runs,
)
from arcade_torch.tools.measures.contamination import ContaminationOptions, measure
from arcade_torch.tools.measures.contamination.example import (
    action_names,
    contamination_example_figure,
    row_names,
)
from arcade_torch.tools.measures.section import Cells, section
from arcade_torch.tools.options import at_least

MEASURES = {
    "flip": "share of changed decisions",
    "change": "change of A / spread of A",
    "kl": "KL(pi || pi') in nats",
}
LEAST_SCALE = 0.1  # axes reach at least so far, so that small effects look small
POWERLESS_BELOW = 0.02
"""Noise on the very frame that decides changes so few decisions: it cannot matter to any other."""

NOISE: Mapping[str, Any] = {
    "sigmas": (0.3,),
    "delays": (0, 1, 2, 5, 10, 20),
    "starts": 32,
    "cap": 96,
}
"""Options of `contamination` for a report; a figure for a paper takes whole episodes, and more."""
OF_RUN = (measure.contamination, NOISE)  # what a report measures of a run, and how

# of one agent on one task: for each of `MEASURES` values [S, K] over its seeds
Measures = Mapping[str, Pooled]


def by_delay(options: ContaminationOptions, progress: Progress | None) -> Made:
    """Figures ``contamination-KIND-GAME-TWIN``, one a task, and examples of each task's first
    agent.
    """
    at_least(options, horizon=2, seed=0)
    paths, notes = checkpoints_of(options.runs)
    measured = measure_runs(paths, measure.contamination, vars(options), progress)
    result = Made([], notes, [_table(label, changes) for label, changes in measured])
    result.notes += _powerless_notes(measured)
    tasks = style.agents_by_task(pool(by_task(measured), options.confidence))
    for (game, twin), agents in tasks.items():
        seeds = [pair for pair in measured if pair[0].task[1:] == (game, twin)]
        result.pictures.append(_picture(game, twin, agents, seeds[0][1], options))
        label = seeds[0][0]
        try:
            settings = vars(options) | {"sigma": max(options.sigmas)}
            _, example = measure_run(label.path, measure.contamination_example, settings)
        except ValueError as error:  # episodes too short
            result.notes.append(f"no example of {label}: {error}")
        else:
            name = f"contamination-{_kind(options)}-example-{game}-{twin}"
            result.pictures.append(Picture(name, *_example(label, example)))
    return result


def _powerless_notes(measured: Sequence[tuple[Label, measure.Contamination]]) -> list[str]:
    """Which noise cannot matter to which checkpoint, a line each."""
    notes = list[str]()
    for label, changes in measured:
        powerless = list[str]()
        for sigma, share in zip(changes.sigmas, ceiling(changes), strict=True):
            if share < POWERLESS_BELOW:
                powerless.append("the shuffle" if np.isnan(sigma) else f"sigma {sigma:g}")
        if powerless:
            notes.append(
                f"{label}: {' and '.join(powerless)} cannot matter: at most "
                f"{100 * POWERLESS_BELOW:g} % of decisions change even on the frame that decides, "
                "so zeros after it say nothing about memory; see analyze counterfactual"
            )
    return notes


def ceiling(changes: measure.Contamination) -> Any:
    """The most that each strength of noise can do, float64 [S]: the share of decisions that change
    at delay 0; NaN where that was not measured.
    """
    if changes.delays[0] != 0:
        return np.full(len(changes.sigmas), np.nan)
    return changes.mean("flip")[:, 0]


def _kind(options: ContaminationOptions) -> str:
    return "shuffle" if options.shuffle else "noise"


def _picture(
    game: str,
    twin: str,
    agents: Mapping[str, Measures],
    seed: measure.Contamination,
    options: ContaminationOptions,
) -> Picture:
    """The figure of one task; strengths, delays and start points are those of one ``seed``."""
    figure = _figure(agents, seed, options, f"{game}, {style.TWIN_NAMES[twin]}")
    rows = list[dict[str, Any]]()
    counts = list[int]()
    for agent, measures in agents.items():
        seeds = np.isfinite(measures["flip"].seeds).sum(0)
        counts += seeds[seeds > 0].tolist()
        columns = {"agent": agent, "game": game, "observability": twin, "seeds": seeds}
        columns["sigma"] = None if options.shuffle else seed.sigmas[:, None]
        columns["delay"] = seed.delays
        for name in MEASURES:
            columns[name] = measures[name].mean
            columns[f"{name}_low"] = measures[name].low
            columns[f"{name}_high"] = measures[name].high
        rows += style.rows_of(**columns)
    ceiling = "last shuffled frame" if options.shuffle else "decision's own frame"
    actions = "replay chooses its actions" if options.feedback else "recorded actions"
    note = (
        f"{style.seeds_note(counts, options.confidence)}; {len(seed.points)} start points each, "
        f"{actions};\n"
        f"0 steps: the {ceiling}; dashed: without memory nothing changes after it"
    )
    return Picture(f"contamination-{_kind(options)}-{game}-{twin}", figure, note, rows)


def _example(label: Label, example: measure.Example) -> tuple[Any, str, list[dict[str, Any]]]:
    """The figure of an example, what stands below it, and its numbers."""
    agent, game, twin = label.task
    title = f"{label.agent}, {label.game}, {style.TWIN_NAMES[label.observability]}"
    figure = contamination_example_figure(example, title=title, figure=style.new_figure())
    names = row_names(example)
    numbers = list[dict[str, Any]]()
    for row, hit in enumerate(example.hits):
        numbers += style.rows_of(
            agent=agent,
            game=game,
            observability=twin,
            row=names[row],
            hit=None if hit < 0 else hit,
            action=action_names(example),
            value=example.values[row],
        )
    shuffle = example.hits[1] < 0
    noise = "frames 2 to 10 shuffled" if shuffle else f"noise sigma = {example.sigma:g}"
    note = f"n = 1 episode, {noise}; blue: best action when clean, red: best if another"
    return figure, note, numbers


def _table(label: Label, changes: measure.Contamination) -> Table:
    """The changed decisions of one checkpoint: a row a strength, a column a delay."""
    rows = list[list[str]]()
    for sigma, shares in zip(changes.sigmas, changes.mean("flip"), strict=True):
        name = "shuffled" if np.isnan(sigma) else f"{sigma:g}"
        rows.append([name, *(f"{100 * share:.1f}" for share in shares)])
    by_delay = ", ".join(map(str, changes.counts()[0]))
    caption = (
        f"{len(changes.points)} start points ({by_delay} by delay); a frame replaced by itself "
        f"moves outputs by {changes.clean_error:.1e}"
    )
    head = ("sigma", *(f"+{delay}" for delay in changes.delays))
    return Table(f"{label}: changed decisions in %", head, rows, caption)


def pool(
    tasks: Mapping[tuple[str, str, str], Sequence[measure.Contamination]], confidence: float = 0.95
) -> dict[tuple[str, str, str], Measures]:
    """(agent, game, twin) -> measures over its seeds."""
    pooled_tasks: dict[tuple[str, str, str], Measures] = {}
    for task, items in tasks.items():
        measures = {}
        for name in MEASURES:
            means = [item.mean(name) for item in items]  # type: ignore[arg-type]
            measures[name] = pooled(means, confidence)
        pooled_tasks[task] = measures
    return pooled_tasks


def _figure(
    agents: Mapping[str, Measures],
    first: measure.Contamination,
    options: ContaminationOptions,
    title: str,
) -> Any:
    """One row a measure, one column a strength of the noise; the dashed line is an agent without
    memory.
    """
    names = [name for name in MEASURES if _is_measured(name, agents.values())]
    size = max(6.5, 3.6 * len(first.sigmas)), 1.3 + 2.5 * len(names)
    figure, axes = style.panels(len(names), len(first.sigmas), size, sharex=True, sharey="row")
    delays = first.delays[: reached(agents.values())].tolist()
    for row, name in zip(axes, names, strict=True):
        for column, axis in enumerate(row):
            plot(agents, axis, name, column, delays)
        row[0].set_ylabel(MEASURES[name])
        from_zero(row[0])
    start = "shuffled frames" if options.shuffle else "noisy frame to the decision"
    for sigma, top, bottom in zip(first.sigmas, axes[0], axes[-1], strict=True):
        top.set_title("" if options.shuffle else f"noise sigma = {sigma:g}")
        bottom.set_xlabel(f"steps from the {start}")
    handles, _ = axes[0, 0].get_legend_handles_labels()
    style.legend_above(figure, handles, 6, "outside upper right", title)
    return figure


def contamination_figure(
    changes: Mapping[str, measure.Contamination | Sequence[measure.Contamination]],
    *,
    name: str = "flip",
    figure: Any = None,
) -> Any:
    """Draw what noise changes by delay, a line a name, a panel a strength; dashed is an agent
    without memory.

    Args:
        changes: by name what `contamination` gave, or that of several seeds, which get bars; all
            with the same strengths and delays.
        name: which of `MEASURES`.
        figure: an empty figure to draw into; a new one of ``matplotlib.pyplot`` by default.

    Returns:
        A matplotlib figure.
    """
    check_by_name("changes", changes)
    seeds = dict[tuple[str, str, str], list[measure.Contamination]]()
    for agent, given in changes.items():
        seeds[agent, "", ""] = [given] if isinstance(given, measure.Contamination) else list(given)
    all_seeds = list(chain.from_iterable(seeds.values()))
    require(
        all(seeds.values()) and len(all_seeds) > 0, "changes", changes, "of one policy at least"
    )
    require(name in MEASURES, "name", name, f"one of {', '.join(MEASURES)}")
    _check_alike(all_seeds)
    agents = {task[0]: measures for task, measures in pool(seeds).items()}
    first = all_seeds[0]
    figure = need("matplotlib.pyplot").figure() if figure is None else figure
    figure.set_size_inches(max(5.4, 3.2 * len(first.sigmas)), 3.2)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(1, len(first.sigmas), squeeze=False, sharey="row")[0]
    delays = first.delays[: reached(agents.values())].tolist()
    for column, axis in enumerate(axes):
        plot(agents, axis, name, column, delays)
        sigma = first.sigmas[column]
        axis.set_title("shuffled" if np.isnan(sigma) else f"noise sigma = {sigma:g}")
        axis.set_xlabel("steps to the decision")
    axes[0].set_ylabel(MEASURES[name])
    from_zero(axes[0])
    style.legend_above(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def _check_alike(seeds: Sequence[measure.Contamination]) -> None:
    """Refuse contaminations of other strengths or delays than the first has."""
    for other in seeds[1:]:
        same_sigmas = np.array_equal(seeds[0].sigmas, other.sigmas, equal_nan=True)
        if not same_sigmas or not np.array_equal(seeds[0].delays, other.delays):
            raise ValueError(
                "changes in one figure must have the same sigmas and delays, got "
                f"{seeds[0].sigmas.tolist()} and {other.sigmas.tolist()}, "
                f"{seeds[0].delays.tolist()} and {other.delays.tolist()}"
            )


def reached(agents: Iterable[Measures]) -> int:
    """How many of the delays were reached: episodes may be shorter than the longest one."""
    delays = set[int]()
    for measures in agents:
        for values in measures.values():
            _, finite = np.nonzero(np.isfinite(values.mean))
            delays.update(finite.tolist())
    return max(delays) + 1


def _is_measured(name: str, agents: Iterable[Measures]) -> bool:
    """Whether some agent has a value of one of `MEASURES`."""
    return any(np.isfinite(measures[name].mean).any() for measures in agents)


def from_zero(axis: Any) -> None:
    """Let the y axis begin at zero and reach `LEAST_SCALE` at least."""
    top = max(axis.get_ylim()[1], LEAST_SCALE)
    axis.set_ylim(-0.05 * top, top)


def plot(
    agents: Mapping[str, Measures],
    axis: Any,
    name: str,
    column: int,
    delays: Sequence[int],
    colours: Mapping[str, str] | None = None,
) -> None:
    """Draw one measure by delay, a line an agent; the dashed line is an agent without memory."""
    colours = colours or style.agent_colours(list(agents))
    markers = style.agent_markers(agents, colours)
    for place, (agent, value) in enumerate(agents.items()):
        mean = value[name].mean[column, : len(delays)]
        low = value[name].low[column, : len(delays)]
        high = value[name].high[column, : len(delays)]
        x = np.arange(len(delays)) + 0.1 * (place - (len(agents) - 1) / 2)
        bars = style.whiskers(mean, low, high)
        axis.plot(
            x, mean, color=colours[agent], marker=markers[agent], label=style.legend_name(agent)
        )
        axis.errorbar(x, mean, bars, fmt="none", ecolor=colours[agent], capsize=2, lw=1)
    axis.axhline(0.0, color=style.NEUTRAL, lw=1, ls="--")
    axis.set_xticks(range(len(delays)), [str(delay) for delay in delays])
    note = _why_empty(name, [value[name].mean[column] for value in agents.values()])
    axis.text(0.5, 0.6, note, transform=axis.transAxes, ha="center", color=style.NEUTRAL)


def _why_empty(name: str, means: Sequence[Any]) -> str:
    """Why a panel shows no line, or only lines on its zero; empty if it shows some."""
    values = np.array(means)
    if not np.isfinite(values).any():
        return "not measured: no episode is so long, or outputs are all alike"
    if np.nanmax(values) > 0:
        return ""
    return "no decision changes" if name == "flip" else "nothing changes"


def contamination_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None
) -> dict[str, Any]:
    """Share of decisions that one noisy frame changes, by delay; a picture a task.

    ``short`` has the tasks whose episodes are too short for some delay, and the longest that is
    there.
    """
    colours = style.agent_colours(agents)

    def draw(by_agent: Mapping[str, Measures], axis: Any) -> None:
        delays = NOISE["delays"][: reached(by_agent.values())]
        plot(by_agent, axis, "flip", 0, delays, colours)
        from_zero(axis)
        axis.set_xlabel("steps after the noisy frame")

    share = "decisions changed"
    parts = section("contamination", cells, OF_RUN, _section_row, draw, share, progress)
    short = dict[str, int]()
    for row in parts["rows"]:
        task = f"{row['game']} {row['twin']}"
        short[task] = max(row["longest"], short.get(task, 0))
    parts["short"] = {task: delay for task, delay in short.items() if delay < NOISE["delays"][-1]}
    return parts


def _section_row(
    measured: Sequence[tuple[Any, measure.Contamination]],
) -> tuple[Measures, dict[str, Any]]:
    """The measures of one cell pooled over its seeds, and its row of the table."""
    measures = next(iter(pool(by_task(measured)).values()))
    seeds = [seed for _, seed in measured]
    later = np.concatenate([seed.flip[:, 0, 1:].ravel() for seed in seeds])
    most = np.mean([ceiling(seed)[0] for seed in seeds])
    flip = measures["flip"].mean[0]
    row = {
        "seeds": len(seeds),
        "points": sum(len(seed.points) for seed in seeds),
        "at_once": flip[0],
        "one": flip[1],
        "later": float(np.ma.filled(np.ma.masked_invalid(later).mean(), np.nan)),
        "change": measures["change"].mean[0, 1],
        "powerless": bool(most < POWERLESS_BELOW),
        "longest": int(seeds[0].delays[reached([measures]) - 1]),
    }
    return measures, row
