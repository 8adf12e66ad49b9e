"""State contamination: flip rate and relative change by delay, with intervals over seeds."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Pooled, pooled
from arcade_torch.tools.analysis.checkpoints import Label, by_task, checkpoints_of, measure_runs
from arcade_torch.tools.analysis.contamination import Contamination, contamination
from arcade_torch.tools.figures import ContaminationOptions, Made, Picture, Progress, style
from arcade_torch.tools.files import Table

MEASURES = {
    "flip": "share of changed decisions",
    "change": "change of A / spread of A",
    "kl": "KL(pi || pi') in nats",
}
LEAST_SCALE = 0.1  # axes reach at least so far, so that small effects look small

Measures = Mapping[str, Pooled]  # of one agent on one task: for each of `MEASURES` values [S, K] over its seeds


def by_delay(options: ContaminationOptions, progress: Progress | None) -> Made:
    """Figures ``contamination-KIND-GAME-TWIN``, one a task."""
    paths, notes = checkpoints_of(options.runs)
    measured = measure_runs(paths, contamination, vars(options), progress)
    made = Made([], notes, [_table(label, item) for label, item in measured])
    first = measured[0][1]  # strengths and delays are those of all
    for (game, twin), agents in style.agents_by_task(pool(by_task(measured), options.confidence)).items():
        figure = _figure(agents, first, options)
        figure.suptitle(f"{game}, {style.TWIN_NAMES[twin]}", x=0.01, ha="left")
        seeds = {agent: len(value["flip"].seeds) for agent, value in agents.items()}
        points = next(len(item.points) for label, item in measured if label.task[1:] == (game, twin))
        ceiling = "last shuffled frame" if options.shuffle else "decision's own frame"
        note = (
            f"{style.seeds_note(list(seeds.values()), options.confidence)}; {points} start points each, "
            f"{'replay chooses its actions' if options.feedback else 'recorded actions'};\n"
            f"0 steps: the {ceiling}; dashed: without memory nothing changes after it"
        )
        rows = []
        for agent, value in agents.items():
            what = {"agent": agent, "game": game, "observability": twin, "seeds": seeds[agent]}
            what |= {"sigma": None if options.shuffle else first.sigmas[:, None], "delay": first.delays}
            for name in MEASURES:
                what |= zip((name, f"{name}_low", f"{name}_high"), value[name][1:], strict=True)
            rows += style.rows_of(**what)
        kind = "shuffle" if options.shuffle else "noise"
        made.pictures.append(Picture(f"contamination-{kind}-{game}-{twin}", figure, note, rows))
    return made


def _table(label: Label, found: Contamination) -> Table:
    names = ["shuffled" if np.isnan(sigma) else f"{sigma:g}" for sigma in found.sigmas]
    rows = [[name, *(f"{100 * x:.1f}" for x in line)] for name, line in zip(names, found.mean("flip"), strict=True)]
    counts = f"{len(found.points)} start points ({', '.join(map(str, found.counts()[0]))} by delay)"
    caption = f"{counts}; a frame replaced by itself moves outputs by {found.clean_error:.1e}"
    head = ("sigma", *(f"+{delay}" for delay in found.delays))
    return Table(f"{label}: changed decisions in %", head, rows, caption)


def pool(
    tasks: Mapping[tuple[str, str, str], Sequence[Contamination]], confidence: float = 0.95
) -> dict[tuple[str, str, str], Measures]:
    """(agent, game, twin) -> measures over its seeds."""
    return {
        task: {name: pooled([item.mean(name) for item in items], confidence) for name in MEASURES}  # type: ignore[arg-type]
        for task, items in tasks.items()
    }


def _figure(agents: Mapping[str, Measures], first: Contamination, options: ContaminationOptions) -> Any:
    """One row a measure, one column a strength of the noise; the dashed line is an agent without memory."""
    shown = [name for name in MEASURES if any(np.isfinite(value[name].mean).any() for value in agents.values())]
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
        bottom.set_xlabel(f"steps from the {'shuffled frames' if options.shuffle else 'noisy frame to the decision'}")
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
        axis.plot(x, mean, color=colours[agent], marker=style.MARKERS[place % len(style.MARKERS)], label=agent)
        axis.errorbar(x, mean, style.whiskers(mean, low, high), **bars)
    axis.axhline(0.0, color=style.NEUTRAL, lw=1, ls="--")
    axis.set_xticks(range(len(delays)), [str(delay) for delay in delays])
