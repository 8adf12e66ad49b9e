"""Recall density: bars of few bins with all memory models pooled, curves of many bins for each model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.binning import no_memory, uniform_memory
from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.analysis.checkpoints import Label, check_distinct, density_of_run
from arcade_torch.tools.analysis.recall_density import RecallDensity
from arcade_torch.tools.analysis.subject import Twin
from arcade_torch.tools.figures.registry import Made, Request
from arcade_torch.tools.figures.runs import find_runs, listed
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

BARS_UP_TO = 6
"""Up to so many bins are drawn as stacked bars, more as curves."""

MEMORY_FREE = ("mlp", "feedforward")
POINTS = 101

Densities = Sequence[tuple[Label, RecallDensity]]


@dataclass(frozen=True)
class Pooled:
    """Mass in bins over the seeds of one agent on one task.

    Attributes:
        seeds: float64 [n, B].
        mean: float64 [B].
        low: float64 [B], NaN with a single seed.
        high: float64 [B].
    """

    seeds: Array
    mean: Array
    low: Array
    high: Array


def make(request: Request) -> Made:
    """Figures ``recall-density-B`` for every number of bins."""
    found = find_runs(request.runs)
    densities, notes = measure([run.folder.path for run in found.runs], request, None)
    made = draw(densities, request)
    return Made(made.files, found.notes + found.single_seeds() + notes + made.notes)


def measure(
    paths: Sequence[Path], request: Request, observability: Twin | None, **options: Any
) -> tuple[list[tuple[Label, RecallDensity]], list[str]]:
    """Densities of checkpoints, and notes on those that gave none.

    Args:
        paths: run folders or checkpoints.
        request: its ``episodes``, ``end`` and ``progress`` count.
        observability: another twin than the one trained on.
        **options: of `recall_density`.
    """
    densities, empty = [], []
    options = {"episodes": request.episodes, "end": request.end} | options
    for path in paths:
        label, density = density_of_run(path, options, observability, request.tell(path.name))
        if density.shares:
            densities.append((label, density))
        else:
            empty.append(f"{path.name} ({density.dropped} too short, {density.silent} without gradient)")
    check_distinct([label for label, _ in densities])
    if not densities:
        raise ValueError(f"no trajectory is left of any checkpoint: {listed(empty)}")
    notes = [f"left out, no trajectory: {listed(empty)}"] if empty else []
    short = sum(density.dropped for _, density in densities)
    if short:
        notes.append(f"{short} trajectories with fewer than 3 frames were left out")
    return densities, notes


def draw(densities: Densities, request: Request) -> Made:
    """Draw and save what `measure` found; also one npz file with every trajectory."""
    files: list[Path] = []
    notes: list[str] = []
    twins = {(label.agent, label.game): set[str]() for label, _ in densities}
    for label, _ in densities:
        twins[label.agent, label.game].add(label.observability)
    alone = [f"{agent} on {game}" for (agent, game), seen in twins.items() if len(seen) < 2]
    if alone:
        notes.append(f"only one twin is there: {listed(alone)}")
    with drawing(request.style) as plt:
        for bins in request.bins:
            pooled = pool(densities, bins, request.confidence)
            plot = stacked_bars if bins <= BARS_UP_TO else binned_curves
            figure = plot(plt, densities, pooled, bins, request)
            extra = _arrays(densities) if bins == request.bins[0] else None
            files += save(figure, request.out / f"recall-density-{bins}", _rows(pooled, bins), extra)
    return Made(files, notes)


def pool(densities: Densities, bins: int, confidence: float) -> dict[tuple[str, str, str], Pooled]:
    """(agent, game, twin) -> its mass in bins: mean over trajectories of a checkpoint, then over seeds."""
    tasks: dict[tuple[str, str, str], list[Array]] = {}
    for label, density in densities:
        tasks.setdefault(label.task, []).append(density.mass(bins))
    return {task: Pooled(np.array(rows), *over_seeds(np.array(rows), confidence)) for task, rows in tasks.items()}


def stacked_bars(
    plt: Any, densities: Densities, pooled: Mapping[tuple[str, str, str], Pooled], bins: int, request: Request
) -> Any:
    """Two panels, MDP and POMDP; a bar a game, all memory models and seeds pooled; the darkest part is most recent."""
    remembering = {task: value for task, value in pooled.items() if not _memory_free(task[0])} or dict(pooled)
    games = list(dict.fromkeys(game for _, game, _ in remembering))
    size = inches(request.style, max(8.0, 3.4 + 1.1 * len(games)), 4.2)
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
    under = f"mean over {', '.join(agents)}; n = {seeds} x {_trajectories(densities)}; {_end(request)}; "
    footnote(figure, under + "dotted: uniform memory; without memory: all in the most recent part")
    return figure


def binned_curves(
    plt: Any, densities: Densities, pooled: Mapping[tuple[str, str, str], Pooled], bins: int, request: Request
) -> Any:
    """One row an agent, one panel a game; MDP and POMDP, with reference lines."""
    agents = list(dict.fromkeys(agent for agent, _, _ in pooled))
    games = list(dict.fromkeys(game for _, game, _ in pooled))
    size = inches(request.style, max(6.4, 3.4 * len(games)), 1.1 + 2.7 * len(agents))
    figure, axes = plt.subplots(
        len(agents), len(games), figsize=size, squeeze=False, sharex=True, sharey=True, layout="constrained"
    )
    edges = np.arange(bins + 1) / bins
    for row, agent in enumerate(agents):
        for column, game in enumerate(games):
            axis = axes[row, column]
            lengths = [int(n) for label, d in densities if label.task[:2] == (agent, game) for n in d.lengths]
            for twin in ("full", "partial"):
                if (value := pooled.get((agent, game, twin))) is not None:
                    _curve(axis, value, edges, TWIN_COLOURS[twin], TWIN_NAMES[twin])
            axis.stairs(uniform_memory(bins), edges, color=NEUTRAL, lw=1, ls=":", label="uniform memory")
            if lengths:
                axis.stairs(no_memory(lengths, bins), edges, color=NEUTRAL, lw=1, ls="-.", label="no memory")
            axis.set_title(f"{agent}, {game}")
            axis.set_xlim(0, 1)
            axis.set_ylim(0, 1.05)
    for axis in axes[-1]:
        axis.set_xlabel("time in the trajectory (1: the decision)")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"share in 1/{bins}")
    handles: dict[str, Any] = {}
    for axis in axes.flat:
        handles |= {label: handle for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=4)
    counts = [len(value.seeds) for value in pooled.values()]
    under = f"{seeds_note(counts, request.confidence, 'bands')} x {_trajectories(densities)}; {_end(request)}"
    footnote(figure, under)
    return figure


def _curve(axis: Any, value: Pooled, edges: Array, colour: str, name: str) -> None:
    if np.isfinite(value.low).all():
        axis.stairs(value.high, edges, baseline=value.low, color=colour, alpha=0.22, fill=True, lw=0)
    axis.stairs(value.mean, edges, color=colour, label=name, ls="-" if name == "MDP" else (0, (4, 1)))


def _memory_free(agent: str) -> bool:
    return agent.rpartition("-")[2] in MEMORY_FREE


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


def _end(request: Request) -> str:
    return "decision: the one that ended the episode" if request.end == "last" else "decision: at a random step"


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
