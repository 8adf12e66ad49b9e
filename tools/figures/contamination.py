"""State contamination: flip rate and relative change by delay, with intervals over seeds; and single examples."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from arcade_torch.tools.analysis import checkpoints
from arcade_torch.tools.analysis import contamination as measures
from arcade_torch.tools.analysis.bootstrap import Array, Pooled, pooled
from arcade_torch.tools.analysis.checkpoints import Label
from arcade_torch.tools.analysis.contamination import LAST, Contamination, Examples
from arcade_torch.tools.analysis.windows import episode_window
from arcade_torch.tools.figures import style
from arcade_torch.tools.figures.registry import ContaminationOptions, Made, Picture, Progress
from arcade_torch.tools.files import Table

MEASURES = {
    "flip": "share of changed decisions",
    "change": "change of A / spread of A",
    "kl": "KL(pi || pi') in nats",
}
LEAST_SCALE = 0.1  # axes reach at least so far, so that small effects look small
ACTIONS = ("up", "down", "left", "right", "fire")

Measures = Mapping[str, Pooled]  # of one agent on one task: for each of `MEASURES` values [S, K] over its seeds


def by_delay(options: ContaminationOptions, progress: Progress | None) -> Made:
    """Figures ``contamination-KIND-GAME-TWIN`` and, of each task's first agent, an example."""
    if options.horizon < 2:
        raise ValueError(f"--horizon must be at least 2, got {options.horizon}")
    paths, notes = checkpoints.checkpoints_of(options.runs)
    names = ["delays", "starts", "feedback", "target", "seed", *([] if options.shuffle else ["sigmas", "clip"])]
    how = {name: getattr(options, name) for name in names}
    measure = measures.shuffled_beginning if options.shuffle else measures.contamination
    measured = checkpoints.measure_runs(paths, measure, how, options.observability, progress)
    made = Made([], notes, [_table(label, item) for label, item in measured])
    every = pool(checkpoints.by_task(measured), options.confidence)
    for game, twin in dict.fromkeys((label.game, label.observability) for label, _ in measured):
        here = {task[0]: value for task, value in every.items() if task[1:] == (game, twin)}
        label, first = next(item for item in measured if item[0].task[1:] == (game, twin))
        made.pictures.append(_by_delay(here, first, game, twin, options))
        found = _example(label, options)
        if found is None:
            made.notes.append(f"no example of {label.path.name}: its episodes are too short")
        else:
            made.pictures.append(_example_picture(label, found, _kind(options)))
    return made


def _kind(options: ContaminationOptions) -> str:
    return "shuffle" if options.shuffle else "noise"


def _table(label: Label, found: Contamination) -> Table:
    rows = [
        ["shuffled" if np.isnan(sigma) else f"{sigma:g}", *(f"{100 * x:.1f}" for x in line)]
        for sigma, line in zip(found.sigmas, found.mean("flip"), strict=True)
    ]
    return Table(
        f"{label}: changed decisions in %",
        ("sigma", *(f"+{delay}" for delay in found.delays)),
        rows,
        f"{len(found.points)} start points ({', '.join(map(str, found.counts()[0]))} by delay); "
        f"a frame replaced by itself moves outputs by {found.clean_error:.1e}",
    )


def pool(
    tasks: Mapping[tuple[str, str, str], Sequence[Contamination]], confidence: float = 0.95
) -> dict[tuple[str, str, str], Measures]:
    """(agent, game, twin) -> measures over its seeds."""
    return {
        task: {name: pooled([item.mean(name) for item in items], confidence) for name in MEASURES}  # type: ignore[arg-type]
        for task, items in tasks.items()
    }


def _by_delay(
    agents: Mapping[str, Measures], first: Contamination, game: str, twin: str, options: ContaminationOptions
) -> Picture:
    """One row a measure, one column a strength of the noise; the dashed line is an agent without memory."""
    shown = [name for name in MEASURES if any(np.isfinite(value[name].mean).any() for value in agents.values())]
    size = max(6.5, 3.6 * len(first.sigmas)), 1.3 + 2.5 * len(shown)
    figure, axes = style.panels(len(shown), len(first.sigmas), size, sharex=True, sharey="row")
    delays = first.delays[: reached(agents.values())].tolist()
    for row, name in enumerate(shown):
        for column, sigma in enumerate(first.sigmas):
            plot(agents, axes[row, column], name, column, delays)
            axes[0, column].set_title("" if options.shuffle else f"noise sigma = {sigma:g}")
        axes[row, 0].set_ylabel(MEASURES[name])
        from_zero(axes[row, 0])
    for axis in axes[-1]:
        axis.set_xlabel(f"steps from the {'shuffled frames' if options.shuffle else 'noisy frame to the decision'}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=6)
    figure.suptitle(f"{game}, {style.TWIN_NAMES[twin]}", x=0.01, ha="left")
    seeds = {agent: len(value["flip"].seeds) for agent, value in agents.items()}
    ceiling = "last shuffled frame" if options.shuffle else "decision's own frame"
    note = (
        f"{style.seeds_note(list(seeds.values()), options.confidence)}; {len(first.points)} start points each, "
        f"{'replay chooses its actions' if options.feedback else 'recorded actions'};\n"
        f"0 steps: the {ceiling}; dashed: without memory nothing changes after it"
    )
    numbers = []
    for agent, value in agents.items():
        what = {"agent": agent, "game": game, "observability": twin, "seeds": seeds[agent]}
        what |= {"sigma": None if options.shuffle else first.sigmas[:, None], "delay": first.delays}
        ends = {name + end: getattr(value[name], part) for name in MEASURES for end, part in ENDS.items()}
        numbers += style.rows_of(**what, **ends)
    return Picture(f"contamination-{_kind(options)}-{game}-{twin}", figure, note, numbers)


ENDS = {"": "mean", "_low": "low", "_high": "high"}


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
    places = np.arange(len(delays))
    for place, (agent, value) in enumerate(agents.items()):
        mean, low, high = (getattr(value[name], part)[column, : len(delays)] for part in ENDS.values())
        x = places + 0.1 * (place - (len(agents) - 1) / 2)
        bars = {"fmt": "none", "ecolor": colours[agent], "capsize": 2, "lw": 1}
        axis.plot(x, mean, color=colours[agent], marker=style.MARKERS[place % len(style.MARKERS)], label=agent)
        axis.errorbar(x, mean, style.whiskers(low, mean, high), **bars)
    axis.axhline(0.0, color=style.NEUTRAL, lw=1, ls="--")
    axis.set_xticks(places, [str(delay) for delay in delays])


def _example(label: Label, options: ContaminationOptions) -> Examples | None:
    """Of one checkpoint: noise on three frames before the decision, or shuffled early frames; None if it is short."""
    twin: Any = label.observability
    agent, _ = checkpoints.load_labelled(label.path, twin)
    last = max(options.horizon, LAST + 3) if options.shuffle else options.horizon
    tries = [episode_window(agent, seed=seed, observability=twin, max_steps=last + 1) for seed in range(3)]
    window = max(tries, key=lambda window: window.n)
    if window.n < (LAST + 1 if options.shuffle else 2):
        return None
    hits = {max(0, window.n - max(1, round(share * window.n))) for share in (0.9, 0.5, 0.1)}
    return measures.examples(agent, window, () if options.shuffle else sorted(hits))


def _example_picture(label: Label, item: Examples, kind: str) -> Picture:
    """Rows: undisturbed and disturbed versions; columns: some of their frames and the bars of the last decision."""
    rows, count = item.names.shape
    size = 1.75 * (count + 1.6), 1.9 * rows + 0.6
    figure, axes = style.panels(rows, count + 1, size, width_ratios=[1.0] * count + [1.6])
    figure.suptitle(f"{label.agent}, {label.game}, {style.TWIN_NAMES[label.observability]}", x=0.02, ha="left")
    ends = min(0.0, float(item.values.min())), max(0.0, float(item.values.max()))
    margin = 0.08 * (ends[1] - ends[0]) or 0.1
    for row, (*pictures, bars) in enumerate(axes):
        for axis, frame, step in zip(pictures, item.frames[row], item.names[row], strict=True):
            axis.imshow(frame, interpolation="nearest")
            axis.set_title(f"$o_{{{step}}}$", fontsize="small")
            axis.set(xticks=[], yticks=[], frame_on=False)
        pictures[0].set_ylabel(item.labels[row], fontsize="small")
        _bars(bars, item.values[row], style.DISTURBED_BEST if row else style.CLEAN_BEST, int(item.values[0].argmax()))
        bars.set_ylim(ends[0] - margin, ends[1] + margin)
    name = "probability" if item.target == "probs" else "relative value A"
    axes[0, -1].set_title(f"{name} at $o_{{{item.n}}}$", fontsize="small")
    note = "coloured bar: best action (blue: undisturbed, red: disturbed); dot: best action undisturbed"
    arrays = {"frames": item.frames, "values": item.values, "labels": np.array(item.labels)}
    return Picture(f"contamination-{kind}-example-{label.game}-{label.observability}", figure, note, (), arrays)


def _bars(axis: Any, values: Array, colour: str, clean: int) -> None:
    colours = [style.OTHER_BAR] * len(values)
    colours[int(values.argmax())] = colour
    axis.bar(range(len(values)), values, color=colours)
    axis.plot([clean], [values[clean]], "o", color="black")
    axis.axhline(0.0, color=style.NEUTRAL, lw=0.8)
    names = ACTIONS if len(values) == len(ACTIONS) else [str(i) for i in range(len(values))]
    axis.set_xticks(range(len(values)), names, rotation=45, ha="right", fontsize="small")
