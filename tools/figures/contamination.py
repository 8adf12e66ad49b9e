"""State contamination: flip rate and relative change by delay, with intervals over seeds; and
single examples.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from arcade_torch.envs_jax import ACTION_NAMES
from arcade_torch.tools.analysis import contamination as measure
from arcade_torch.tools.analysis.bootstrap import Pooled, pooled
from arcade_torch.tools.analysis.checkpoints import (
    Label,
    by_task,
    checkpoints_of,
    measure_run,
    measure_runs,
)
from arcade_torch.tools.figures import ContaminationOptions, Made, Picture, Progress, style
from arcade_torch.tools.files import Table
from arcade_torch.tools.options import at_least

MEASURES = {
    "flip": "share of changed decisions",
    "change": "change of A / spread of A",
    "kl": "KL(pi || pi') in nats",
}
LEAST_SCALE = 0.1  # axes reach at least so far, so that small effects look small
# bars of an example, as in the paper
CLEAN_BEST = "#354e6a"
OTHER_BEST = "#a33a2f"
REST = "#b3b3b3"

# of one agent on one task: for each of `MEASURES` values [S, K] over its seeds
Measures = Mapping[str, Pooled]


def by_delay(options: ContaminationOptions, progress: Progress | None) -> Made:
    """Figures ``contamination-KIND-GAME-TWIN``, one a task, and examples of each task's first
    agent.
    """
    at_least(options, horizon=2, seed=0)
    paths, notes = checkpoints_of(options.runs)
    measured = measure_runs(paths, measure.contamination, vars(options), progress)
    made = Made([], notes, [_table(label, item) for label, item in measured])
    first = measured[0][1]  # strengths and delays are those of all
    for (game, twin), agents in style.agents_by_task(
        pool(by_task(measured), options.confidence)
    ).items():
        figure = _figure(agents, first, options)
        figure.suptitle(f"{game}, {style.TWIN_NAMES[twin]}", x=0.01, ha="left")
        seeds = {agent: np.isfinite(value["flip"].seeds).sum(0) for agent, value in agents.items()}
        counts = [count for each in seeds.values() for count in each.ravel().tolist() if count]
        label, item = next(pair for pair in measured if pair[0].task[1:] == (game, twin))
        ceiling = "last shuffled frame" if options.shuffle else "decision's own frame"
        note = (
            f"{style.seeds_note(counts, options.confidence)}; {len(item.points)} start points "
            "each, "
            f"{'replay chooses its actions' if options.feedback else 'recorded actions'};\n"
            f"0 steps: the {ceiling}; dashed: without memory nothing changes after it"
        )
        rows = []
        for agent, value in agents.items():
            what = {"agent": agent, "game": game, "observability": twin, "seeds": seeds[agent]}
            what |= {
                "sigma": None if options.shuffle else first.sigmas[:, None],
                "delay": first.delays,
            }
            for name in MEASURES:
                what |= zip((name, f"{name}_low", f"{name}_high"), value[name][1:], strict=True)
            rows += style.rows_of(**what)
        kind = "shuffle" if options.shuffle else "noise"
        made.pictures.append(Picture(f"contamination-{kind}-{game}-{twin}", figure, note, rows))
        try:
            how = vars(options) | {"sigma": max(options.sigmas)}
            _, example = measure_run(label.path, measure.contamination_example, how)
        except ValueError as error:  # episodes too short
            made.notes.append(f"no example of {label}: {error}")
        else:
            made.pictures.append(
                Picture(f"contamination-{kind}-example-{game}-{twin}", *_example(label, example))
            )
    return made


def _example(label: Label, found: measure.Example) -> tuple[Any, str, list[dict[str, Any]]]:
    """Rows: an episode as it was, and disturbed; columns: some of its frames, and bars of the
    outputs on its last.
    """
    n = found.frames.shape[1] - 1
    best = found.values.argmax(1)
    shuffle = found.hits[1] < 0
    names = [
        "clean",
        *("shuffled" if shuffle else f"noise on frame {hit}" for hit in found.hits[1:]),
    ]
    columns = 6 if shuffle else 3
    size = (1.6 * (columns + 1.7), 1.7 * len(names) + 0.8)
    look = {"width_ratios": [1.0] * columns + [1.7]}
    figure, axes = style.panels(len(names), columns + 1, size, sharey="col", **look)
    task = dict(zip(("agent", "game", "observability"), label.task, strict=True))
    numbers = list[dict[str, Any]]()
    for row, (*pictures, bars) in enumerate(axes):
        early = (
            range(measure.FIRST + 1, measure.FIRST + 4)
            if shuffle
            else (0, max(found.hits[row], found.hits[1]))
        )
        for axis, t in zip(pictures, (*early, *range(n - 2 * shuffle, n + 1)), strict=True):
            axis.imshow(found.frames[row, t], interpolation="nearest")
            axis.set(xticks=[], yticks=[], frame_on=False)
            axis.set_title(f"$o_{{{found.order[row, t]}}}$", parse_math=True)
        pictures[0].set_ylabel(names[row], fontsize="small")
        bars.bar(ACTION_NAMES, found.values[row], color=REST)
        bars.patches[best[row]].set_facecolor(OTHER_BEST)
        bars.patches[best[0]].set_facecolor(CLEAN_BEST)
        bars.axhline(0.0, color=style.NEUTRAL, lw=0.8)
        bars.tick_params(labelsize="small")
        hit = None if found.hits[row] < 0 else found.hits[row]
        numbers += style.rows_of(
            **task, row=names[row], hit=hit, action=ACTION_NAMES, value=found.values[row]
        )
    outputs = "probabilities" if found.target == "probs" else f"centred {found.target}"
    axes[0, -1].set_title(f"{outputs} on $o_{{{n}}}$", parse_math=True)
    figure.suptitle(
        f"{label.agent}, {label.game}, {style.TWIN_NAMES[label.observability]}", x=0.01, ha="left"
    )
    noise = "frames 2 to 10 shuffled" if shuffle else f"noise sigma = {found.sigma:g}"
    note = f"n = 1 episode, {noise}; blue: best action when clean, red: best if another"
    return figure, note, numbers


def _table(label: Label, found: measure.Contamination) -> Table:
    names = ["shuffled" if np.isnan(sigma) else f"{sigma:g}" for sigma in found.sigmas]
    rows = [
        [name, *(f"{100 * x:.1f}" for x in line)]
        for name, line in zip(names, found.mean("flip"), strict=True)
    ]
    counts = f"{len(found.points)} start points ({', '.join(map(str, found.counts()[0]))} by delay)"
    caption = f"{counts}; a frame replaced by itself moves outputs by {found.clean_error:.1e}"
    head = ("sigma", *(f"+{delay}" for delay in found.delays))
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
    agents: Mapping[str, Measures], first: measure.Contamination, options: ContaminationOptions
) -> Any:
    """One row a measure, one column a strength of the noise; the dashed line is an agent without
    memory.
    """
    shown = [
        name
        for name in MEASURES
        if any(np.isfinite(value[name].mean).any() for value in agents.values())
    ]
    size = max(6.5, 3.6 * len(first.sigmas)), 1.3 + 2.5 * len(shown)
    figure, axes = style.panels(len(shown), len(first.sigmas), size, sharex=True, sharey="row")
    delays = first.delays[: reached(agents.values())].tolist()
    for row, name in zip(axes, shown, strict=True):
        for column, axis in enumerate(row):
            plot(agents, axis, name, column, delays)
        row[0].set_ylabel(MEASURES[name])
        from_zero(row[0])
    for sigma, top, bottom in zip(first.sigmas, axes[0], axes[-1], strict=True):
        top.set_title("" if options.shuffle else f"noise sigma = {sigma:g}")
        bottom.set_xlabel(
            "steps from the "
            f"{'shuffled frames' if options.shuffle else 'noisy frame to the decision'}"
        )
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=6)
    return figure


def reached(agents: Iterable[Measures]) -> int:
    """How many of the delays were reached: episodes may be shorter than the longest one."""
    known = [np.isfinite(one.mean).any(0) for value in agents for one in value.values()]
    return int(np.flatnonzero(np.any(known, axis=0))[-1]) + 1


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
    for place, (agent, value) in enumerate(agents.items()):
        mean, low, high = (part[column, : len(delays)] for part in value[name][1:])
        x = np.arange(len(delays)) + 0.1 * (place - (len(agents) - 1) / 2)
        bars = {"fmt": "none", "ecolor": colours[agent], "capsize": 2, "lw": 1}
        marker = style.MARKERS[place % len(style.MARKERS)]
        axis.plot(x, mean, color=colours[agent], marker=marker, label=style.legend_name(agent))
        axis.errorbar(x, mean, style.whiskers(mean, low, high), **bars)
    axis.axhline(0.0, color=style.NEUTRAL, lw=1, ls="--")
    axis.set_xticks(range(len(delays)), [str(delay) for delay in delays])
