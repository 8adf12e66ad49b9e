"""Recall density: bars of few bins with all memory models pooled, curves of many bins for each model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from arcade_torch.tools.analysis.binning import no_memory, uniform_memory
from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.analysis.checkpoints import Label, checkpoints_of, density_of_run, with_names
from arcade_torch.tools.analysis.recall_density import RecallDensity
from arcade_torch.tools.figures import registry
from arcade_torch.tools.figures.registry import Made, Progress, tell
from arcade_torch.tools.figures.style import (
    MDP_THIRDS,
    NEUTRAL,
    POMDP_THIRDS,
    TWIN_COLOURS,
    TWIN_NAMES,
    drawing,
    footnote,
    inches,
    save,
    seeds_note,
)
from arcade_torch.tools.runs import is_baseline, listed
from arcade_torch.tools.tables import Table

BARS_UP_TO = 6
"""Up to so many bins are drawn as stacked bars, more as curves."""

MEMORY_FREE = ("mlp", "feedforward")
POINTS = 101

Densities = Sequence[tuple[Label, RecallDensity]]


@dataclass(frozen=True)
class Pooled:
    """Mass in bins over the seeds of one agent on one task."""

    seeds: Array
    mean: Array
    low: Array
    high: Array


@dataclass
class Options(registry.Options):
    """Options of the figure."""

    bins: tuple[int, ...] = (3, 16)
    """Numbers of bins, a figure each; up to 6 as stacked bars."""
    episodes: int = 100
    """Greedy trajectories of each checkpoint."""
    end: Literal["last", "random"] = "last"
    """The decision: the one that ended the episode, or a random one."""
    observability: Literal["full", "partial"] | None = None
    """Another twin than the agents were trained on."""
    max_frames: int = 512
    """Longest trajectory; a longer episode gives a window with a random end."""
    norm: Literal["l1", "l2sq", "l2"] = "l1"
    """Norm of a gradient over a frame."""
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    target: Literal["auto", "q", "logits", "probs", "value"] = "auto"
    """What is differentiated; Q-values, or a policy's probabilities, by default."""
    seed: int = 0
    """Of the episodes."""
    confidence: float = 0.95
    """Of the bands."""


def make(options: Options, progress: Progress | None) -> Made:
    """Figures ``recall-density-B`` for every number of bins; one npz file with every trajectory."""
    options.checkpoints()
    options.check_folder()
    if not options.bins or min(options.bins) < 1 or options.episodes < 1:
        raise ValueError(f"--bins and --episodes must be at least 1, got {list(options.bins)} and {options.episodes}")
    paths, notes = checkpoints_of(options.runs)
    densities, more = measure(paths, options, progress)
    made = Made([], notes + more)
    with drawing(options.style) as plt:
        for bins in options.bins:
            pooled = pool(densities, bins, options.confidence)
            draw = stacked_bars if bins <= BARS_UP_TO else binned_curves
            figure = draw(plt, densities, pooled, bins, options)
            extra = _arrays(densities) if bins == options.bins[0] else None
            rows = _rows(pooled, bins)
            made.files += save(options, f"recall-density-{bins}", figure, rows, extra)
            made.rows = [*made.rows, *rows]
    head = ("run", "trajectories", "mean length", "on the last frame %", "thirds %")
    cells = [
        (
            label,
            len(density.shares),
            f"{density.lengths.mean():.1f}",
            f"{100 * density.last_share():.1f}",
            " / ".join(f"{100 * mass:.1f}" for mass in density.mass(3)),
        )
        for label, density in densities
    ]
    made.tables.append(Table("share of the gradient of the last decision", head, cells))
    return made


def measure(
    paths: Sequence[Path], options: Options, progress: Progress | None = None
) -> tuple[list[tuple[Label, RecallDensity]], list[str]]:
    """Densities of checkpoints, and notes on those that gave none.

    Args:
        paths: run folders or checkpoints.
        options: of the measure.
        progress: called with (run, trajectories done, of how many).

    Raises:
        ValueError: no trajectory is left of any checkpoint.
    """
    how: dict[str, Any] = {
        "episodes": options.episodes,
        "end": options.end,
        "cap": options.max_frames,
        "norm": options.norm,
    }
    how |= {"reduce": options.reduce, "target": options.target, "seed": options.seed}
    densities, empty = [], []
    for path in paths:
        label, density = density_of_run(path, how, options.observability, tell(progress, path.name))
        if density.shares:
            densities.append((label, density))
        else:
            empty.append(f"{path.name} ({density.dropped} too short, {density.silent} without gradient)")
    if not densities:
        raise ValueError(f"no trajectory is left of any checkpoint: {listed(empty)}")
    notes = [f"left out, no trajectory: {listed(empty)}"] if empty else []
    short = sum(density.dropped for _, density in densities)
    notes += [f"{short} trajectories with fewer than 3 frames were left out"] if short else []
    densities = with_names(densities)
    twins = {(label.agent, label.game): set[str]() for label, _ in densities}
    for label, _ in densities:
        twins[label.agent, label.game].add(label.observability)
    alone = [f"{agent} on {game}" for (agent, game), seen in twins.items() if len(seen) < 2]
    return densities, notes + ([f"only one twin is there: {listed(alone)}"] if alone else [])


def pool(densities: Densities, bins: int, confidence: float) -> dict[tuple[str, str, str], Pooled]:
    """(agent, game, twin) -> its mass in bins: mean over trajectories of a checkpoint, then over seeds."""
    tasks: dict[tuple[str, str, str], list[Array]] = {}
    for label, density in densities:
        tasks.setdefault(label.task, []).append(density.mass(bins))
    return {task: Pooled(np.array(rows), *over_seeds(np.array(rows), confidence)) for task, rows in tasks.items()}


def stacked_bars(
    plt: Any, densities: Densities, pooled: Mapping[tuple[str, str, str], Pooled], bins: int, options: Options
) -> Any:
    """Two panels, MDP and POMDP; a bar a game, all memory models and seeds pooled; the darkest part is most recent."""
    remembering = {task: value for task, value in pooled.items() if not _memory_free(task[0])} or dict(pooled)
    games = list(dict.fromkeys(game for _, game, _ in remembering))
    size = inches(options.style, max(8.0, 3.4 + 1.1 * len(games)), 4.2)
    figure, axes = plt.subplots(1, 2, figsize=size, sharey=True, layout="constrained")
    for axis, twin, shades in zip(axes, ("full", "partial"), (MDP_THIRDS, POMDP_THIRDS), strict=True):
        chosen = [[value.mean for (_, name, t), value in remembering.items() if (name, t) == (g, twin)] for g in games]
        here = [(i, np.mean(rows, axis=0)) for i, rows in enumerate(chosen) if rows]
        colours = _shades(plt, shades, bins)
        below = np.zeros(len(here))
        for part in range(bins):
            heights = np.array([mass[part] for _, mass in here])
            label = _part_name(part, bins)
            axis.bar([i for i, _ in here], heights, 0.7, below, color=colours[part], label=label)
            below = below + heights
        for level in np.arange(1, bins) / bins:
            axis.axhline(level, color=NEUTRAL, lw=0.9, ls=":", zorder=3)
        axis.set_xticks(range(len(games)), games, rotation=30, ha="right", rotation_mode="anchor")
        axis.set_xlim(-0.6, len(games) - 0.4)
        axis.set_ylim(0, 1.05)
        axis.set_title(TWIN_NAMES[twin])
        if here:
            axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), reverse=True, fontsize="small")
    axes[0].set_ylabel("share of the gradient")
    agents = list(dict.fromkeys(agent for agent, _, _ in remembering))
    counts = [len(value.seeds) for value in remembering.values()]
    seeds = f"{_range(counts)} seed{'s' * (max(counts) > 1)}"
    under = f"mean over {', '.join(agents)}; n = {seeds} x {_trajectories(densities)}; {_end(options)}; "
    footnote(figure, under + "dotted: uniform memory; without memory: all in the most recent part")
    return figure


def binned_curves(
    plt: Any, densities: Densities, pooled: Mapping[tuple[str, str, str], Pooled], bins: int, options: Options
) -> Any:
    """One row an agent, one panel a game; MDP and POMDP, with reference lines."""
    agents = list(dict.fromkeys(agent for agent, _, _ in pooled))
    games = list(dict.fromkeys(game for _, game, _ in pooled))
    size = inches(options.style, max(6.4, 3.4 * len(games)), 1.1 + 2.7 * len(agents))
    figure, axes = plt.subplots(
        len(agents), len(games), figsize=size, squeeze=False, sharex=True, sharey=True, layout="constrained"
    )
    for row, agent in enumerate(agents):
        for column, game in enumerate(games):
            axis = axes[row, column]
            lengths = [int(n) for label, d in densities if label.task[:2] == (agent, game) for n in d.lengths]
            twins = {
                TWIN_NAMES[twin]: (pooled[agent, game, twin], TWIN_COLOURS[twin])
                for twin in ("full", "partial")
                if (agent, game, twin) in pooled
            }
            plot(twins, axis, bins, lengths)
            axis.set_title(f"{agent}, {game}")
    for axis in axes[-1]:
        axis.set_xlabel("time in the trajectory (1: the decision)")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"share in 1/{bins}")
    handles: dict[str, Any] = {}
    for axis in axes.flat:
        handles |= {label: handle for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=4)
    counts = [len(value.seeds) for value in pooled.values()]
    under = f"{seeds_note(counts, options.confidence, 'bands')} x {_trajectories(densities)}; {_end(options)}"
    footnote(figure, under)
    return figure


def plot(series: Mapping[str, tuple[Pooled, str]], axis: Any, bins: int, lengths: Sequence[int] = ()) -> None:
    """Draw densities over the time of a trajectory, with the reference lines of uniform memory and of none."""
    edges = np.arange(bins + 1) / bins
    for place, (name, (value, colour)) in enumerate(series.items()):
        if np.isfinite(value.low).all():
            axis.stairs(value.high, edges, baseline=value.low, color=colour, alpha=0.22, fill=True, lw=0)
        axis.stairs(value.mean, edges, color=colour, label=name, ls="-" if place % 2 == 0 else (0, (4, 1)), lw=1.8)
    axis.stairs(uniform_memory(bins), edges, color=NEUTRAL, lw=1, ls=":", label="uniform memory")
    if len(lengths):
        axis.stairs(no_memory(lengths, bins), edges, color=NEUTRAL, lw=1, ls="-.", label="no memory")
    axis.set_xlim(0, 1)
    axis.set_ylim(0, 1.05)


def _memory_free(agent: str) -> bool:
    return any(is_baseline(agent, name) for name in MEMORY_FREE)


def _shades(plt: Any, thirds: Sequence[str], bins: int) -> list[Any]:
    from matplotlib.colors import LinearSegmentedColormap

    if bins == len(thirds):
        return list(thirds)
    blend = LinearSegmentedColormap.from_list("shades", list(thirds))
    return [blend(part / max(1, bins - 1)) for part in range(bins)]


def _part_name(part: int, bins: int) -> str:
    if bins == 3:
        return ("oldest third", "middle third", "most recent third")[part]
    return f"{part + 1} of {bins}"


def _trajectories(densities: Densities) -> str:
    counts = [len(density.shares) for _, density in densities]
    frames = np.concatenate([density.lengths for _, density in densities])
    return f"{_range(counts)} greedy trajectories (mean length {frames.mean():.0f} frames)"


def _range(counts: Sequence[int]) -> str:
    return str(min(counts)) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def _end(options: Options) -> str:
    return "decision: the one that ended the episode" if options.end == "last" else "decision: at a random step"


def _rows(pooled: Mapping[tuple[str, str, str], Pooled], bins: int) -> list[dict[str, Any]]:
    return [
        {
            "agent": agent,
            "game": game,
            "observability": twin,
            "bins": bins,
            "bin": part,
            "seeds": len(value.seeds),
            "mass": value.mean[part],
            "low": value.low[part],
            "high": value.high[part],
        }
        for (agent, game, twin), value in pooled.items()
        for part in range(bins)
    ]


def _arrays(densities: Densities) -> dict[str, Any]:
    """Every trajectory of every checkpoint, and the paper's point-sampled curve."""
    taus = np.linspace(0.0, 1.0, POINTS)
    labels = [f"{label.agent} {label.game} {label.observability} seed{label.seed}" for label, _ in densities]
    arrays: dict[str, Any] = {"labels": np.array(labels), "taus": taus}
    arrays["points"] = np.array([density.points(taus) for _, density in densities])
    for index, (_, density) in enumerate(densities):
        arrays[f"shares_{index}"] = np.concatenate(density.shares)
        arrays[f"lengths_{index}"] = density.lengths
    return arrays
