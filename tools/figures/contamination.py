"""State contamination: flip rate and relative change by delay, with intervals over seeds; and single examples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.analysis.checkpoints import Label, check_distinct, contamination_of_run, load_labelled
from arcade_torch.tools.analysis.contamination import Contamination
from arcade_torch.tools.analysis.contamination_examples import ACTIONS, Examples, noise_examples, shuffle_example
from arcade_torch.tools.analysis.episode_saliency import episode_window
from arcade_torch.tools.analysis.subject import Twin
from arcade_torch.tools.analysis.windows import Window
from arcade_torch.tools.figures.registry import Made, Request
from arcade_torch.tools.figures.runs import find_runs
from arcade_torch.tools.figures.style import (
    CLEAN_BEST,
    DISTURBED_BEST,
    MARKERS,
    NEUTRAL,
    OTHER_BAR,
    TWIN_NAMES,
    agent_colour,
    drawing,
    footnote,
    inches,
    save,
    seeds_note,
    whiskers,
)

MEASURES = {
    "flip": "share of changed decisions",
    "change": "change of A / spread of A",
    "kl": "KL(pi || pi') in nats",
}
LEAST_SCALE = 0.1
"""Axes reach at least so far, so that nothing looks like much."""
STARTS_AN_EPISODE = 2
"""The figure takes twice as many start points as it is asked for episodes."""

Found = Sequence[tuple[Label, Contamination]]


@dataclass(frozen=True)
class Pooled:
    """One agent on one task: for each measure mean, low, high, each [S, K]; its number of seeds."""

    values: Mapping[str, tuple[Array, Array, Array]]
    seeds: int


def make(request: Request) -> Made:
    """Figures ``contamination-GAME-TWIN`` and, of each task's first agent with memory, an example."""
    found = find_runs(request.runs)
    options = {"starts": STARTS_AN_EPISODE * request.episodes}
    measured = measure([run.folder.path for run in found.runs], request, options)
    made = draw(measured, request)
    return Made(made.files, found.notes + found.single_seeds() + made.notes)


def measure(
    paths: Sequence[Path],
    request: Request,
    options: Mapping[str, Any],
    shuffle: bool = False,
    observability: Twin | None = None,
) -> list[tuple[Label, Contamination]]:
    """Contamination of checkpoints.

    Args:
        paths: run folders or checkpoints.
        request: its ``progress`` counts.
        options: of `contamination` or `shuffled_beginning`.
        shuffle: permute early frames in place of adding noise.
        observability: another twin than the one trained on.
    """
    found = []
    for path in paths:
        found.append(contamination_of_run(path, options, shuffle, observability, request.tell(path.name)))
    check_distinct([label for label, _ in found])
    return found


def draw(measured: Found, request: Request, horizon: int = 10) -> Made:
    """Draw and save what `measure` found: one figure a task, one example of its first agent at step ``horizon``."""
    files: list[Path] = []
    notes: list[str] = []
    pooled = pool(measured, request.confidence)
    kind = measured[0][1].kind
    with drawing(request.style) as plt:
        for game, twin in dict.fromkeys((label.game, label.observability) for label, _ in measured):
            here = {task[0]: value for task, value in pooled.items() if task[1:] == (game, twin)}
            first = next(item for label, item in measured if (label.game, label.observability) == (game, twin))
            figure = lines(plt, here, first, f"{game}, {TWIN_NAMES[twin]}", request)
            base = request.out / f"contamination-{kind}-{game}-{twin}"
            files += save(figure, base, _rows(here, first, game, twin))
            chosen = next(label for label, _ in measured if (label.game, label.observability) == (game, twin))
            examples, why = example_of(chosen, kind, horizon)
            if examples is None:
                notes.append(why)
                continue
            title = f"{chosen.agent}, {game}, {TWIN_NAMES[twin]}"
            arrays = {"frames": examples.frames, "values": examples.values, "labels": np.array(examples.labels)}
            picture = example_figure(plt, [(title, examples)], request.style)
            files += save(picture, request.out / f"contamination-{kind}-example-{game}-{twin}", (), arrays)
    return Made(files, notes)


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


def lines(plt: Any, agents: Mapping[str, Pooled], first: Contamination, title: str, request: Request) -> Any:
    """One row a measure, one column a strength of the noise; the dashed line is an agent without memory."""
    shown = [name for name in MEASURES if any(np.isfinite(value.values[name][0]).any() for value in agents.values())]
    columns = len(first.sigmas)
    size = inches(request.style, max(6.5, 3.6 * columns), 1.3 + 2.5 * len(shown))
    figure, axes = plt.subplots(
        len(shown), columns, figsize=size, squeeze=False, sharex=True, sharey="row", layout="constrained"
    )
    reached = [np.isfinite(mean).any(0) for value in agents.values() for mean, _, _ in value.values.values()]
    count = int(np.flatnonzero(np.any(reached, axis=0))[-1]) + 1  # episodes may be shorter than the longest delay
    places = np.arange(count)
    for row, name in enumerate(shown):
        for column, sigma in enumerate(first.sigmas):
            axis = axes[row, column]
            for place, (agent, value) in enumerate(agents.items()):
                mean, low, high = (part[column, :count] for part in value.values[name])
                colour = agent_colour(agent, place)
                x = places + 0.1 * (place - (len(agents) - 1) / 2)
                axis.plot(x, mean, color=colour, marker=MARKERS[place % len(MARKERS)], label=agent)
                known = np.isfinite(low)
                if known.any():
                    errors = whiskers(low[known], mean[known], high[known])
                    axis.errorbar(x[known], mean[known], errors, fmt="none", ecolor=colour, capsize=2, lw=1)
            axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
            axis.set_xticks(places, [str(delay) for delay in first.delays[:count]])
            if row == 0 and np.isfinite(sigma):
                axis.set_title(f"noise sigma = {sigma:g}")
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
        f"{seeds_note([value.seeds for value in agents.values()], request.confidence)}; "
        f"{len(first.points)} start points each, {how};\n{ceiling}; dashed: without memory nothing changes after it",
    )
    return figure


def example_of(label: Label, kind: str, horizon: int) -> tuple[Examples | None, str]:
    """A single example of one checkpoint: noise on three frames before the decision, or shuffled frames 2 to 10.

    Args:
        label: which checkpoint.
        kind: ``noise`` or ``shuffle``.
        horizon: index of the decision; earlier where the episode ends earlier, at least 13 for ``shuffle``.

    Returns:
        The example, or why there is none.
    """
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


def example_figure(plt: Any, groups: Sequence[tuple[str, Examples]], style: str) -> Any:
    """Rows: undisturbed and disturbed versions; columns: some of their frames and the bars of the last decision.

    Args:
        plt: from `drawing`.
        groups: (title, examples), side by side.
        style: light or print.
    """
    rows = max(len(item.labels) for _, item in groups)
    pictures = sum(item.frames.shape[1] + 1.6 for _, item in groups)
    figure = plt.figure(figsize=inches(style, 1.75 * pictures, 1.9 * rows + 0.6), layout="constrained")
    widths = [item.frames.shape[1] + 1.6 for _, item in groups]
    parts = figure.subfigures(1, len(groups), squeeze=False, width_ratios=widths)[0]
    for part, (title, item) in zip(parts, groups, strict=True):
        part.suptitle(title, x=0.02, ha="left")
        count = item.frames.shape[1]
        axes = part.subplots(len(item.labels), count + 1, squeeze=False, width_ratios=[1.0] * count + [1.6])
        best = int(item.values[0].argmax())
        for row, label in enumerate(item.labels):
            for column in range(count):
                axis = axes[row, column]
                axis.imshow(item.frames[row, column], interpolation="nearest")
                axis.set_title(f"${item.names[row][column]}$", fontsize="small")
                axis.set_axis_off()
            axes[row, 0].set_axis_on()
            axes[row, 0].set(xticks=[], yticks=[])
            axes[row, 0].spines[:].set_visible(False)
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
