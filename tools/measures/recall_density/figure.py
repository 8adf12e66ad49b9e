"""Recall density: bars of few bins with all memory models pooled, curves of many bins for each
model.
"""

from collections.abc import Mapping, Sequence
from itertools import chain, product
from typing import Any

import numpy as np

from arcade_torch.tools.comparable import listed
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import Made, Picture, Progress, style
from arcade_torch.tools.figures.style import TWIN_NAMES
from arcade_torch.tools.files import Table
from arcade_torch.tools.measures.arguments import check_by_name
from arcade_torch.tools.measures.bootstrap import Array, Pooled, pooled
from arcade_torch.tools.measures.checkpoints import Label, by_task, checkpoints_of, measure_runs
from arcade_torch.tools.measures.recall_density import DensityOptions, measure
from arcade_torch.tools.measures.saliency.figure import INSTEAD, vanishing
from arcade_torch.tools.measures.section import Cells, section
from arcade_torch.tools.names import memory_free
from arcade_torch.tools.options import at_least

BARS_UP_TO = 6  # so many bins are drawn as stacked bars, more as curves
MEMORY_FREE = ("mlp", "feedforward")
THIRDS = ("oldest third", "middle third", "most recent third")
SHADES = {"full": style.MDP_THIRDS, "partial": style.POMDP_THIRDS}
POINTS = 101  # of the paper's curve, in the npz file

# of a report: parts of an episode, or as many as the shortest episode of a task has frames
BINS = 8
DENSITY: Mapping[str, Any] = {"episodes": 16, "cap": 96}
"""Options of `recall_density` for a report; a figure for a paper takes whole episodes, and more."""
OF_RUN = (measure.recall_density, DENSITY)  # what a report measures of a run, and how

Densities = Sequence[tuple[Label, measure.RecallDensity]]
# (agent, game, twin) -> mass in bins, over trajectories, then seeds
Masses = Mapping[tuple[str, str, str], Pooled]


def densities(options: DensityOptions, progress: Progress | None) -> Made:
    """Figures ``recall-density-B`` for every number of bins; one npz file with every trajectory."""
    at_least(options, bins=1, episodes=1, seed=0)
    measured, notes = _measure(options, progress)
    result = Made([], notes + vanishing_notes(measured, options.norm))
    frames = np.concatenate([density.lengths for _, density in measured])
    counts = _range([len(density.lengths) for _, density in measured])
    end = "the one that ended the episode" if options.end == "last" else "at a random step"
    for bins in options.bins:
        masses = _masses(measured, bins, options.confidence)
        if bins <= BARS_UP_TO:
            figure, seeds = _stacked_bars(masses, bins)
        else:
            figure, seeds = _curves(measured, masses, bins, options.confidence)
        note = (
            f"{seeds}; {counts} greedy trajectories a run, "
            f"{frames.mean():.0f} frames long on average; decision: {end}"
        )
        if bins <= BARS_UP_TO:
            note += "; dotted: uniform memory; without memory: all in the most recent part"
        arrays = _arrays(measured) if bins == options.bins[0] else {}
        rows = _rows(masses, bins)
        result.pictures.append(Picture(f"recall-density-{bins}", figure, note, rows, arrays))
    result.tables.append(_table(measured))
    return result


def vanishing_notes(measured: Densities, norm: str = "l1") -> list[str]:
    """One line for every run whose gradients vanish, on average over its decisions."""
    notes = list[str]()
    for label, density in measured:
        certainty = float(density.certainty.mean())
        why = vanishing(density.target, certainty, float(density.sizes.mean()), norm)
        if why:
            notes.append(
                f"{label}: shares of the gradient say nothing: {why} on average; {INSTEAD}"
            )
    return notes


def _masses(measured: Densities, bins: int, confidence: float) -> Masses:
    """The mass in bins of every task, pooled over its seeds."""
    masses_of_runs = [(label, density.mass(bins)) for label, density in measured]
    masses = {}
    for task, seeds in by_task(masses_of_runs).items():
        masses[task] = pooled(seeds, confidence)
    return masses


def _rows(masses: Masses, bins: int) -> list[dict[str, Any]]:
    """The numbers of a figure, one row a bin."""
    rows = list[dict[str, Any]]()
    for (agent, game, twin), mass in masses.items():
        rows += style.rows_of(
            agent=agent,
            game=game,
            observability=twin,
            bins=bins,
            bin=np.arange(bins),
            seeds=len(mass.seeds),
            mass=mass.mean,
            low=mass.low,
            high=mass.high,
        )
    return rows


def _table(measured: Densities) -> Table:
    """Where the gradient of the last decision falls, one row a run."""
    rows = list[tuple[Any, ...]]()
    for label, density in measured:
        trajectories = len(density.lengths)
        mean_length = f"{density.lengths.mean():.1f}"
        last = f"{100 * density.last_share():.1f}"
        thirds = " / ".join(f"{100 * share:.1f}" for share in density.mass(3))
        rows.append((label, trajectories, mean_length, last, thirds))
    head = ("run", "trajectories", "mean length", "on the last frame %", "thirds %")
    return Table("share of the gradient of the last decision", head, rows)


def _measure(options: DensityOptions, progress: Progress | None) -> tuple[Densities, list[str]]:
    """Densities of checkpoints, and notes on those that gave none."""
    paths, notes = checkpoints_of(options.runs)
    settings = vars(options) | {"cap": options.max_frames}
    densities = list[tuple[Label, measure.RecallDensity]]()
    empty = list[str]()
    for label, density in measure_runs(paths, measure.recall_density, settings, progress):
        if density.lengths.size:
            densities.append((label, density))
        else:
            empty.append(
                f"{label.path.name} ({density.dropped} too short, {density.silent} without "
                "gradient)"
            )
    if not densities:
        raise ValueError(
            f"no trajectory is left of any checkpoint: {listed(empty)}; play more episodes, or "
            "take counterfactual recall (analyze counterfactual), which needs no gradient"
        )
    if empty:
        notes.append(f"left out, no trajectory: {listed(empty)}")
    short = sum(density.dropped for _, density in densities)
    if short:
        notes.append(f"{short} trajectories with fewer than 3 frames were left out")
    lacking = _without_both_twins([label for label, _ in densities])
    if lacking:
        notes.append(
            "only one twin is there, or none, and bars are means over the others: "
            f"{listed(lacking)}"
        )
    return densities, notes


def _without_both_twins(labels: Sequence[Label]) -> list[str]:
    """Which pairs of an agent and a game lack a twin."""
    twins: dict[tuple[str, str], set[str]] = {}
    for label in labels:
        twins.setdefault((label.agent, label.game), set()).add(label.observability)
    agents = dict.fromkeys(label.agent for label in labels)
    games = dict.fromkeys(label.game for label in labels)
    lacking = []
    for agent, game in product(agents, games):
        if len(twins.get((agent, game), ())) < 2:
            lacking.append(f"{agent} on {game}")
    return lacking


def _stacked_bars(masses: Masses, bins: int) -> tuple[Any, str]:
    """A panel a twin that is there; a bar a game, all memory models and seeds pooled; the darkest
    part is most recent.
    """
    remembering = {}
    for task, mass in masses.items():
        if not any(memory_free(task[0], name) for name in MEMORY_FREE):
            remembering[task] = mass
    remembering = remembering or dict(masses)
    games = list(dict.fromkeys(game for _, game, _ in remembering))
    tasks = style.agents_by_task(remembering)
    measured_twins = {twin for _, _, twin in remembering}
    twins = [twin for twin in TWIN_NAMES if twin in measured_twins]
    width = max(2.4 + 2.8 * len(twins), 3.4 + 0.55 * len(twins) * len(games))
    figure, axes = style.panels(1, len(twins), (width, 4.2), sharey=True)
    for axis, twin in zip(axes[0], twins, strict=True):
        mass_of_game = {}
        for place, game in enumerate(games):
            agents = tasks.get((game, twin))
            if agents is not None:
                mass_of_game[place] = np.mean([mass.mean for mass in agents.values()], axis=0)
        _plot_stacked(mass_of_game, axis, bins, SHADES[twin])
        axis.set_xticks(range(len(games)), games, rotation=30, ha="right", rotation_mode="anchor")
        axis.set(xlim=(-0.6, len(games) - 0.4), ylim=(0, 1.05), title=TWIN_NAMES[twin])
    axes[0, 0].set_ylabel("share of the gradient")
    names = dict.fromkeys(agent for agent, _, _ in remembering)
    counts = [len(mass.seeds) for mass in remembering.values()]
    seeds = f"n = {_range(counts)} seed{'s' * (max(counts) > 1)}"
    return figure, f"mean over {', '.join(names)}; {seeds}"


def _plot_stacked(masses: Mapping[int, Array], axis: Any, bins: int, shades: Sequence[str]) -> None:
    """Draw a bar of ``bins`` parts at every place of an axis; the darkest part is most recent."""
    places = list(masses)
    parts = np.array(list(masses.values())).reshape(len(places), bins)
    blend = need("matplotlib.colors").LinearSegmentedColormap.from_list("shades", shades)
    for part in range(bins):
        label = THIRDS[part] if bins == 3 else f"{part + 1} of {bins}"
        colour = shades[part] if bins == 3 else blend(part / max(1, bins - 1))
        below = parts[:, :part].sum(1)
        axis.bar(places, parts[:, part], 0.7, below, color=colour, label=label)
    for level in np.arange(1, bins) / bins:
        axis.axhline(level, color=style.NEUTRAL, lw=0.9, ls=":", zorder=3)
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), reverse=True, fontsize="small")


def _curves(measured: Densities, masses: Masses, bins: int, confidence: float) -> tuple[Any, str]:
    """One row an agent, one panel a game; MDP and POMDP, with reference lines."""
    agents = list(dict.fromkeys(agent for agent, _, _ in masses))
    games = list(dict.fromkeys(game for _, game, _ in masses))
    lengths: dict[tuple[str, str], list[int]] = {}
    for label, density in measured:
        lengths.setdefault((label.agent, label.game), []).extend(density.lengths.tolist())
    size = max(6.4, 3.4 * len(games)), 1.1 + 2.7 * len(agents)
    figure, axes = style.panels(len(agents), len(games), size, sharex=True, sharey=True)
    handles: dict[str, Any] = {}
    for axis, (agent, game) in zip(axes.flat, product(agents, games), strict=True):
        series = {}
        for twin, name in TWIN_NAMES.items():
            mass = masses.get((agent, game, twin))
            if mass is not None:
                series[name] = (mass, style.TWIN_COLOURS[twin])
        twins = list(TWIN_NAMES.values())
        plot(series, axis, bins, lengths.get((agent, game), []), twins)
        axis.set_title(f"{agent}, {game}")
        in_panel, labels = axis.get_legend_handles_labels()
        handles |= zip(labels, in_panel, strict=True)
    for axis in axes[-1]:
        axis.set_xlabel("time in the trajectory (1: the decision)")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"share in 1/{bins}")
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=4)
    counts = [len(mass.seeds) for mass in masses.values()]
    return figure, style.seeds_note(counts, confidence, "bands")


def plot(
    series: Mapping[str, tuple[Pooled, str]],
    axis: Any,
    bins: int,
    lengths: Sequence[int] = (),
    names: Sequence[str] = (),
) -> None:
    """Draw densities over the time of a trajectory, with the reference lines of uniform memory and
    of none; the lines of ``names``, those of ``series`` by default, look alike in all panels.
    """
    edges = np.arange(bins + 1) / bins
    places = list(names or series)
    for name, (mass, colour) in series.items():
        if np.isfinite(mass.low).all():
            axis.stairs(
                mass.high, edges, baseline=mass.low, color=colour, alpha=0.22, fill=True, lw=0
            )
        kind = places.index(name) % len(style.DASHES)
        look = {"color": colour, "ls": style.DASHES[kind], "lw": 1.8}
        # broken lines lie on full ones, so that equal lines are all seen
        axis.stairs(mass.mean, edges, baseline=None, label=name, zorder=2 + kind / 10, **look)
    thin = {"baseline": None, "color": style.NEUTRAL, "lw": 1}
    axis.stairs(np.full(bins, 1 / bins), edges, ls=":", label="uniform memory", **thin)
    if len(lengths):
        axis.stairs(measure.no_memory(lengths, bins), edges, ls="-.", label="no memory", **thin)
    axis.set(xlim=(0, 1), ylim=(0, 1.05))


def recall_density_figure(
    densities: Mapping[str, measure.RecallDensity | Sequence[measure.RecallDensity]],
    *,
    bins: int = BINS,
    figure: Any = None,
) -> Any:
    """Draw recall densities over the time of their trajectories, a line a name, with the reference
    lines of uniform memory and of none.

    Args:
        densities: by name what `recall_density` gave, or that of several seeds, which get a band.
        bins: equal parts of a trajectory.
        figure: an empty figure to draw into; a new one of ``matplotlib.pyplot`` by default.

    Returns:
        A matplotlib figure.
    """
    check_by_name("densities", densities)
    figure = need("matplotlib.pyplot").figure() if figure is None else figure
    figure.set_size_inches(5.4, 3.2)
    figure.set_layout_engine("constrained")
    axis = figure.subplots()
    colours = style.agent_colours(list(densities))
    series = {}
    lengths = list[int]()
    for name, seeds in densities.items():
        seeds = [seeds] if isinstance(seeds, measure.RecallDensity) else seeds
        mass = pooled([density.mass(bins) for density in seeds])
        series[style.legend_name(name)] = (mass, colours[name])
        for density in seeds:
            lengths += density.lengths.tolist()
    plot(series, axis, bins, lengths)
    axis.set_xlabel("time in the trajectory (1: the decision)")
    axis.set_ylabel(f"share of the gradient in 1/{bins}")
    style.legend_above(figure, axis.get_legend_handles_labels()[0])
    return figure


def _range(counts: Sequence[int]) -> str:
    return str(min(counts)) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def _arrays(measured: Densities) -> dict[str, Any]:
    """Every trajectory of every checkpoint, and the paper's point-sampled curve."""
    taus = np.linspace(0.0, 1.0, POINTS)
    labels = list[str]()
    points = list[Array]()
    arrays = dict[str, Any]()
    for index, (label, density) in enumerate(measured):
        labels.append(f"{label.agent} {label.game} {label.observability} seed{label.seed}")
        points.append(density.points(taus))
        arrays[f"shares_{index}"] = density.deltas
        arrays[f"lengths_{index}"] = density.lengths
    return {"labels": np.array(labels), "taus": taus, "points": np.array(points)} | arrays


def recall_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None
) -> dict[str, Any]:
    """Recall density of every cell, a picture a task; numbers are kept in the run folders."""
    colours = style.agent_colours(agents)

    def draw(by_agent: Mapping[str, Sequence[measure.RecallDensity]], axis: Any) -> None:
        shortest = min(_shortest(densities) for densities in by_agent.values())
        bins = min(BINS, shortest)
        series = {}
        for agent, densities in by_agent.items():
            mass = pooled([density.mass(bins) for density in densities])
            series[agent] = (mass, colours[agent])
        plot(series, axis, bins, names=agents)
        axis.set_xlabel("time in the episode (1: the decision)")

    share = "share of the gradient"
    return section("recall density", cells, OF_RUN, _section_row, draw, share, progress)


def _shortest(densities: Sequence[measure.RecallDensity]) -> int:
    """The number of frames of the shortest trajectory."""
    return min(int(density.lengths.min()) for density in densities)


def _section_row(
    measured: Sequence[tuple[Any, measure.RecallDensity]],
) -> tuple[list[measure.RecallDensity], dict[str, Any]]:
    """The densities of seeds that have a trajectory, and their row of the table."""
    densities = [density for _, density in measured if density.lengths.size]
    if not densities:
        raise ValueError("no episode of three frames")
    shares = list(chain.from_iterable(density.shares for density in densities))
    row = {
        "seeds": len(densities),
        "episodes": len(shares),
        "length": np.mean([share.size for share in shares]),
        "last": np.mean([share[-1] for share in shares]),
        "first": np.mean([share[0] for share in shares]),
        "older": np.mean([density.mass(2)[0] for density in densities]),
    }
    return densities, row
