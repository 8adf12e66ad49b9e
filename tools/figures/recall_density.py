"""Recall density: bars of few bins with all memory models pooled, curves of many bins for each
model.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from arcade_torch.tools.analysis import recall_density as measure
from arcade_torch.tools.analysis.bootstrap import Pooled, pooled
from arcade_torch.tools.analysis.checkpoints import Label, by_task, checkpoints_of, measure_runs
from arcade_torch.tools.comparable import listed
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import DensityOptions, Made, Picture, Progress, style
from arcade_torch.tools.figures.style import TWIN_NAMES
from arcade_torch.tools.files import Table
from arcade_torch.tools.names import memory_free
from arcade_torch.tools.options import at_least

BARS_UP_TO = 6  # so many bins are drawn as stacked bars, more as curves
MEMORY_FREE = ("mlp", "feedforward")
THIRDS = ("oldest third", "middle third", "most recent third")
POINTS = 101  # of the paper's curve, in the npz file

Densities = Sequence[tuple[Label, measure.RecallDensity]]
# (agent, game, twin) -> mass in bins, over trajectories, then seeds
Masses = Mapping[tuple[str, str, str], Pooled]


def densities(options: DensityOptions, progress: Progress | None) -> Made:
    """Figures ``recall-density-B`` for every number of bins; one npz file with every trajectory."""
    at_least(options, bins=1, episodes=1, seed=0)
    measured, notes = _measure(options, progress)
    made = Made([], notes)
    frames = np.concatenate([density.lengths for _, density in measured])
    counts = _range([len(density.lengths) for _, density in measured])
    end = "the one that ended the episode" if options.end == "last" else "at a random step"
    for bins in options.bins:
        tasks = by_task([(label, density.mass(bins)) for label, density in measured])
        masses = {task: pooled(rows, options.confidence) for task, rows in tasks.items()}
        few = bins <= BARS_UP_TO
        figure, seeds = (
            _stacked_bars(masses, bins)
            if few
            else _curves(measured, masses, bins, options.confidence)
        )
        note = (
            f"{seeds} x {counts} greedy trajectories (mean length {frames.mean():.0f} frames); "
            f"decision: {end}"
        )
        note += "; dotted: uniform memory; without memory: all in the most recent part" * few
        rows = []
        for (agent, game, twin), (values, mass, low, high) in masses.items():
            what = {
                "agent": agent,
                "game": game,
                "observability": twin,
                "bins": bins,
                "bin": np.arange(bins),
            }
            rows += style.rows_of(**what, seeds=len(values), mass=mass, low=low, high=high)
        arrays = _arrays(measured) if bins == options.bins[0] else {}
        made.pictures.append(Picture(f"recall-density-{bins}", figure, note, rows, arrays))
    cells = []
    for label, one in measured:
        thirds = " / ".join(f"{100 * share:.1f}" for share in one.mass(3))
        cells.append(
            (
                label,
                len(one.lengths),
                f"{one.lengths.mean():.1f}",
                f"{100 * one.last_share():.1f}",
                thirds,
            )
        )
    head = ("run", "trajectories", "mean length", "on the last frame %", "thirds %")
    made.tables.append(Table("share of the gradient of the last decision", head, cells))
    return made


def _measure(options: DensityOptions, progress: Progress | None) -> tuple[Densities, list[str]]:
    """Densities of checkpoints, and notes on those that gave none."""
    paths, notes = checkpoints_of(options.runs)
    every = measure_runs(
        paths, measure.recall_density, vars(options) | {"cap": options.max_frames}, progress
    )
    found = [(label, one) for label, one in every if one.lengths.size]
    bare = [(label.path.name, one) for label, one in every if not one.lengths.size]
    empty = listed(
        [f"{name} ({one.dropped} too short, {one.silent} without gradient)" for name, one in bare]
    )
    if not found:
        raise ValueError(f"no trajectory is left of any checkpoint: {empty}")
    if bare:
        notes.append(f"left out, no trajectory: {empty}")
    if short := sum(density.dropped for _, density in found):
        notes.append(f"{short} trajectories with fewer than 3 frames were left out")
    agents, games, _ = map(dict.fromkeys, zip(*by_task(found), strict=True))
    cells = [f"{agent} on {game}" for agent, game, _ in by_task(found)]
    if lacking := [
        cell for agent in agents for game in games if cells.count(cell := f"{agent} on {game}") < 2
    ]:
        notes.append(
            "only one twin is there, or none, and bars are means over the others: "
            f"{listed(lacking)}"
        )
    return found, notes


def _stacked_bars(masses: Masses, bins: int) -> tuple[Any, str]:
    """Two panels, MDP and POMDP; a bar a game, all memory models and seeds pooled; the darkest part
    is most recent.
    """
    remembering = {
        task: value
        for task, value in masses.items()
        if not any(memory_free(task[0], name) for name in MEMORY_FREE)
    } or masses
    games = list(dict.fromkeys(game for _, game, _ in remembering))
    tasks = style.agents_by_task(remembering)
    figure, axes = style.panels(1, 2, (max(8.0, 3.4 + 1.1 * len(games)), 4.2), sharey=True)
    for axis, twin, shades in zip(
        axes[0], TWIN_NAMES, (style.MDP_THIRDS, style.POMDP_THIRDS), strict=True
    ):
        here = [place for place, game in enumerate(games) if (game, twin) in tasks]
        drawn = [
            np.mean([value.mean for value in tasks[games[place], twin].values()], axis=0)
            for place in here
        ]
        parts = np.array(drawn).reshape(len(here), bins)
        blend = need("matplotlib.colors").LinearSegmentedColormap.from_list("shades", shades)
        for part in range(bins):
            label = THIRDS[part] if bins == 3 else f"{part + 1} of {bins}"
            colour = shades[part] if bins == 3 else blend(part / max(1, bins - 1))
            axis.bar(here, parts[:, part], 0.7, parts[:, :part].sum(1), color=colour, label=label)
        for level in np.arange(1, bins) / bins:
            axis.axhline(level, color=style.NEUTRAL, lw=0.9, ls=":", zorder=3)
        axis.set_xticks(range(len(games)), games, rotation=30, ha="right", rotation_mode="anchor")
        axis.set(xlim=(-0.6, len(games) - 0.4), ylim=(0, 1.05), title=TWIN_NAMES[twin])
        if here:
            axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), reverse=True, fontsize="small")
    axes[0, 0].set_ylabel("share of the gradient")
    agents = dict.fromkeys(agent for agent, _, _ in remembering)
    counts = [len(value.seeds) for value in remembering.values()]
    return (
        figure,
        f"mean over {', '.join(agents)}; n = {_range(counts)} seed{'s' * (max(counts) > 1)}",
    )


def _curves(measured: Densities, masses: Masses, bins: int, confidence: float) -> tuple[Any, str]:
    """One row an agent, one panel a game; MDP and POMDP, with reference lines."""
    agents, games = (list(dict.fromkeys(task[part] for task in masses)) for part in (0, 1))
    size = max(6.4, 3.4 * len(games)), 1.1 + 2.7 * len(agents)
    figure, axes = style.panels(len(agents), len(games), size, sharex=True, sharey=True)
    handles: dict[str, Any] = {}
    for agent, line in zip(agents, axes, strict=True):
        for game, axis in zip(games, line, strict=True):
            lengths = [
                int(n)
                for label, d in measured
                if label.task[:2] == (agent, game)
                for n in d.lengths
            ]
            twins = [twin for twin in TWIN_NAMES if (agent, game, twin) in masses]
            series = {
                TWIN_NAMES[twin]: (masses[agent, game, twin], style.TWIN_COLOURS[twin])
                for twin in twins
            }
            plot(series, axis, bins, lengths)
            axis.set_title(f"{agent}, {game}")
            handles |= {
                label: handle
                for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
            }
    for axis in axes[-1]:
        axis.set_xlabel("time in the trajectory (1: the decision)")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"share in 1/{bins}")
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=4)
    return figure, style.seeds_note(
        [len(value.seeds) for value in masses.values()], confidence, "bands"
    )


def plot(
    series: Mapping[str, tuple[Pooled, str]], axis: Any, bins: int, lengths: Sequence[int] = ()
) -> None:
    """Draw densities over the time of a trajectory, with the reference lines of uniform memory and
    of none.
    """
    edges = np.arange(bins + 1) / bins
    for place, (name, (value, colour)) in enumerate(series.items()):
        if np.isfinite(value.low).all():
            axis.stairs(
                value.high, edges, baseline=value.low, color=colour, alpha=0.22, fill=True, lw=0
            )
        axis.stairs(
            value.mean,
            edges,
            color=colour,
            label=name,
            ls="-" if place % 2 == 0 else (0, (4, 1)),
            lw=1.8,
        )
    axis.stairs(
        np.full(bins, 1 / bins), edges, color=style.NEUTRAL, lw=1, ls=":", label="uniform memory"
    )
    if len(lengths):
        axis.stairs(
            measure.no_memory(lengths, bins),
            edges,
            color=style.NEUTRAL,
            lw=1,
            ls="-.",
            label="no memory",
        )
    axis.set(xlim=(0, 1), ylim=(0, 1.05))


def _range(counts: Sequence[int]) -> str:
    return str(min(counts)) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def _arrays(measured: Densities) -> dict[str, Any]:
    """Every trajectory of every checkpoint, and the paper's point-sampled curve."""
    taus = np.linspace(0.0, 1.0, POINTS)
    labels = [
        f"{label.agent} {label.game} {label.observability} seed{label.seed}"
        for label, _ in measured
    ]
    points = np.array([density.points(taus) for _, density in measured])
    arrays: dict[str, Any] = {"labels": np.array(labels), "taus": taus, "points": points}
    for index, (_, density) in enumerate(measured):
        arrays |= {f"shares_{index}": density.deltas, f"lengths_{index}": density.lengths}
    return arrays
