"""State contamination: flip rate and relative change by delay, with intervals over seeds; and single examples."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.analysis.checkpoints import (
    Label,
    checkpoints_of,
    contamination_of_run,
    load_labelled,
    with_names,
)
from arcade_torch.tools.analysis.contamination import Contamination
from arcade_torch.tools.analysis.contamination_examples import ACTIONS, Examples, noise_examples, shuffle_example
from arcade_torch.tools.analysis.resolve import episode_window
from arcade_torch.tools.analysis.windows import Window
from arcade_torch.tools.figures import registry
from arcade_torch.tools.figures.registry import Made, Progress, tell
from arcade_torch.tools.figures.style import (
    CLEAN_BEST,
    DISTURBED_BEST,
    MARKERS,
    NEUTRAL,
    OTHER_BAR,
    TWIN_NAMES,
    agent_colours,
    drawing,
    footnote,
    inches,
    save,
    seeds_note,
    whiskers,
)
from arcade_torch.tools.tables import Table

MEASURES = {
    "flip": "share of changed decisions",
    "change": "change of A / spread of A",
    "kl": "KL(pi || pi') in nats",
}
LEAST_SCALE = 0.1
"""Axes reach at least so far, so that small effects look small."""
Found = Sequence[tuple[Label, Contamination]]


@dataclass(frozen=True)
class Pooled:
    """One agent on one task: for each measure mean, low, high, each [S, K]; its number of seeds."""

    values: Mapping[str, tuple[Array, Array, Array]]
    seeds: int


@dataclass
class Options(registry.Options):
    """Options of the figure."""

    sigmas: tuple[float, ...] = (0.1, 0.3, 1.0)
    """Standard deviations of the noise; 1 is the range of a pixel."""
    delays: tuple[int, ...] = (0, 1, 2, 5, 10, 20, 50, 100)
    """Steps from the noisy frame to the decision; 0 is the ceiling."""
    starts: int = 200
    """Start points of each checkpoint, at most four an episode."""
    horizon: int = 10
    """Step of the decision in the example."""
    shuffle: bool = False
    """Permute frames 2 to 10 in place of adding noise."""
    clip: bool = False
    """Keep noisy pixels in their range."""
    feedback: bool = False
    """Let the replay choose the previous actions itself, as the published code does."""
    observability: Literal["full", "partial"] | None = None
    """Another twin than the agents were trained on."""
    target: Literal["auto", "q", "logits", "probs"] = "auto"
    """What is compared; Q-values, or a policy's probabilities, by default."""
    seed: int = 0
    """Of episodes, start points and noise."""
    confidence: float = 0.95
    """Of the bars."""


def make(options: Options, progress: Progress | None) -> Made:
    """Figures ``contamination-KIND-GAME-TWIN`` and, of each task's first agent, an example."""
    options.checkpoints()
    options.check_folder()
    if options.horizon < 2:
        raise ValueError(f"--horizon must be at least 2, got {options.horizon}")
    paths, notes = checkpoints_of(options.runs)
    measured = measure(paths, options, progress)
    made = Made([], notes)
    pooled = pool(measured, options.confidence)
    kind = measured[0][1].kind
    with drawing(options.style) as plt:
        for game, twin in dict.fromkeys((label.game, label.observability) for label, _ in measured):
            here = {task[0]: value for task, value in pooled.items() if task[1:] == (game, twin)}
            label, first = next(item for item in measured if item[0].task[1:] == (game, twin))
            figure = lines(plt, here, first, f"{game}, {TWIN_NAMES[twin]}", options)
            rows = _rows(here, first, game, twin)
            made.files += save(options, f"contamination-{kind}-{game}-{twin}", figure, rows)
            made.rows = [*made.rows, *rows]
            examples, why = example_of(label, kind, options.horizon)
            if examples is None:
                made.notes.append(why)
                continue
            title = f"{label.agent}, {game}, {TWIN_NAMES[twin]}"
            arrays = {"frames": examples.frames, "values": examples.values, "labels": np.array(examples.labels)}
            picture = example_figure(plt, title, examples, options.style)
            made.files += save(options, f"contamination-{kind}-example-{game}-{twin}", picture, (), arrays)
    made.tables = [_table(label, item, options.shuffle) for label, item in measured]
    return made


def measure(
    paths: Sequence[Path], options: Options, progress: Progress | None = None
) -> list[tuple[Label, Contamination]]:
    """Contamination of checkpoints.

    Args:
        paths: run folders or checkpoints.
        options: of the measure.
        progress: called with (run, start points done, of how many).
    """
    how: dict[str, Any] = {"delays": options.delays, "starts": options.starts, "feedback": options.feedback}
    how |= {"target": options.target, "seed": options.seed}
    how |= {} if options.shuffle else {"sigmas": options.sigmas, "clip": options.clip}
    twin = options.observability
    return with_names(
        [contamination_of_run(path, how, options.shuffle, twin, tell(progress, path.name)) for path in paths]
    )


def _table(label: Label, found: Contamination, shuffle: bool) -> Table:
    rows = [
        ["shuffled" if shuffle else f"{sigma:g}", *(f"{100 * x:.1f}" for x in line)]
        for sigma, line in zip(found.sigmas, found.mean("flip"), strict=True)
    ]
    return Table(
        f"{label}: changed decisions in %",
        ("sigma", *(f"+{delay}" for delay in found.delays)),
        rows,
        f"{len(found.points)} start points ({', '.join(map(str, found.counts()[0]))} by delay); "
        f"a frame replaced by itself moves outputs by {found.clean_error:.1e}",
    )


def pool(measured: Found, confidence: float) -> dict[tuple[str, str, str], Pooled]:
    """(agent, game, twin) -> measures over its seeds."""
    tasks: dict[tuple[str, str, str], list[Contamination]] = {}
    for label, item in measured:
        tasks.setdefault(label.task, []).append(item)
    pooled = {}
    for task, items in tasks.items():
        values = {name: np.array([item.mean(name) for item in items]) for name in MEASURES}  # type: ignore[arg-type]
        pooled[task] = Pooled({name: over_seeds(array, confidence) for name, array in values.items()}, len(items))
    return pooled


def lines(plt: Any, agents: Mapping[str, Pooled], first: Contamination, title: str, options: Options) -> Any:
    """One row a measure, one column a strength of the noise; the dashed line is an agent without memory."""
    shown = [name for name in MEASURES if any(np.isfinite(value.values[name][0]).any() for value in agents.values())]
    columns = len(first.sigmas)
    size = inches(options.style, max(6.5, 3.6 * columns), 1.3 + 2.5 * len(shown))
    figure, axes = plt.subplots(
        len(shown), columns, figsize=size, squeeze=False, sharex=True, sharey="row", layout="constrained"
    )
    count = reached(agents.values())
    for row, name in enumerate(shown):
        for column, sigma in enumerate(first.sigmas):
            plot(agents, axes[row, column], name, column, first.delays[:count].tolist())
            if row == 0 and np.isfinite(sigma):
                axes[row, column].set_title(f"noise sigma = {sigma:g}")
        axes[row, 0].set_ylabel(MEASURES[name])
        top = max(axes[row, 0].get_ylim()[1], LEAST_SCALE)
        axes[row, 0].set_ylim(-0.05 * top, top)
    what = "steps from the noisy frame to the decision" if first.kind == "noise" else "steps from the shuffled frames"
    for axis in axes[-1]:
        axis.set_xlabel(what)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=6)
    figure.suptitle(title, x=0.01, ha="left")
    how = "replay chooses its actions" if first.feedback else "recorded actions"
    ceiling = "0 steps: the decision's own frame" if first.kind == "noise" else "0 steps: the last shuffled frame"
    footnote(
        figure,
        f"{seeds_note([value.seeds for value in agents.values()], options.confidence)}; "
        f"{len(first.points)} start points each, {how};\n{ceiling}; dashed: without memory nothing changes after it",
    )
    return figure


def reached(agents: Iterable[Pooled]) -> int:
    """How many of the delays were reached: episodes may be shorter than the longest one."""
    known = [np.isfinite(mean).any(0) for value in agents for mean, _, _ in value.values.values()]
    return int(np.flatnonzero(np.any(known, axis=0))[-1]) + 1


def plot(
    agents: Mapping[str, Pooled],
    axis: Any,
    name: str,
    column: int,
    delays: Sequence[int],
    colours: Mapping[str, str] | None = None,
) -> None:
    """Draw one measure by delay, a line an agent; the dashed line is an agent without memory."""
    colours = colours or agent_colours(list(agents))
    places = np.arange(len(delays))
    for place, (agent, value) in enumerate(agents.items()):
        mean, low, high = (part[column, : len(delays)] for part in value.values[name])
        colour = colours[agent]
        x = places + 0.1 * (place - (len(agents) - 1) / 2)
        axis.plot(x, mean, color=colour, marker=MARKERS[place % len(MARKERS)], label=agent)
        known = np.isfinite(low)
        if known.any():
            errors = whiskers(low[known], mean[known], high[known])
            axis.errorbar(x[known], mean[known], errors, fmt="none", ecolor=colour, capsize=2, lw=1)
    axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
    axis.set_xticks(places, [str(delay) for delay in delays])


def example_of(label: Label, kind: str, horizon: int) -> tuple[Examples | None, str]:
    """A single example of one checkpoint: noise on three frames before the decision, or shuffled frames 2 to 10."""
    twin: Any = label.observability
    agent, _ = load_labelled(label.path, twin)
    last = horizon if kind == "noise" else max(horizon, 13)
    window = max(
        (episode_window(agent, seed=seed, observability=twin, max_steps=last + 1) for seed in range(3)), key=_n
    )
    shortest = 2 if kind == "noise" else 11
    if window.n < shortest:
        return None, f"no example of {label.path.name}: its episodes are shorter than {shortest + 1} frames"
    if kind == "shuffle":
        return shuffle_example(agent, window), ""
    hits = sorted({max(0, window.n - max(1, round(share * window.n))) for share in (0.9, 0.5, 0.1)})
    return noise_examples(agent, window, hits), ""


def _n(window: Window) -> int:
    return window.n


def example_figure(plt: Any, title: str, item: Examples, style: str) -> Any:
    """Rows: undisturbed and disturbed versions; columns: some of their frames and the bars of the last decision."""
    rows, count = len(item.labels), item.frames.shape[1]
    size = inches(style, 1.75 * (count + 1.6), 1.9 * rows + 0.6)
    figure, axes = plt.subplots(
        rows, count + 1, figsize=size, squeeze=False, width_ratios=[1.0] * count + [1.6], layout="constrained"
    )
    figure.suptitle(title, x=0.02, ha="left")
    best = int(item.values[0].argmax())
    for row, label in enumerate(item.labels):
        for column in range(count):
            axis = axes[row, column]
            axis.imshow(item.frames[row, column], interpolation="nearest")
            axis.set_title(f"${item.names[row][column]}$", fontsize="small")
            axis.set(xticks=[], yticks=[], frame_on=False)
        axes[row, 0].set_ylabel(label, fontsize="small")
        _bars(axes[row, -1], item.values[row], CLEAN_BEST if row == 0 else DISTURBED_BEST, best)
        axes[row, -1].set_ylim(*_limits(item.values))
    name = "probability" if item.target == "probs" else "relative value A"
    axes[0, -1].set_title(f"{name} at $o_{{{item.n}}}$", fontsize="small")
    footnote(figure, "coloured bar: best action (blue: undisturbed, red: disturbed); dot: best action undisturbed")
    return figure


def _bars(axis: Any, values: Array, colour: str, clean: int) -> None:
    colours = [OTHER_BAR] * len(values)
    colours[int(values.argmax())] = colour
    axis.bar(range(len(values)), values, color=colours)
    axis.plot([clean], [values[clean]], "o", color="black")
    axis.axhline(0.0, color=NEUTRAL, lw=0.8)
    names = ACTIONS if len(values) == len(ACTIONS) else [str(i) for i in range(len(values))]
    axis.set_xticks(range(len(values)), names, rotation=45, ha="right", fontsize="small")


def _limits(values: Array) -> tuple[float, float]:
    low, high = min(0.0, float(values.min())), max(0.0, float(values.max()))
    margin = 0.08 * (high - low) or 0.1
    return low - margin, high + margin


def _rows(agents: Mapping[str, Pooled], first: Contamination, game: str, twin: str) -> list[dict[str, Any]]:
    rows = []
    for agent, value in agents.items():
        for s, sigma in enumerate(first.sigmas):
            for k, delay in enumerate(first.delays):
                row: dict[str, Any] = {"agent": agent, "game": game, "observability": twin, "seeds": value.seeds}
                row |= {"sigma": None if np.isnan(sigma) else sigma, "delay": int(delay)}
                for name, (mean, low, high) in value.values.items():
                    row |= {name: mean[s, k], f"{name}_low": low[s, k], f"{name}_high": high[s, k]}
                rows.append(row)
    return rows
