"""The pictures of the page: every one is a figure of `arcade_torch.tools.figures`, as SVG or PNG.

All agents of a small study are looked into, and of a large one a few that stand for the rest.
"""

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.tools.analysis.bootstrap import pooled
from arcade_torch.tools.analysis.checkpoints import by_task, measure_run
from arcade_torch.tools.analysis.contamination import contamination as noise
from arcade_torch.tools.analysis.gap_bias import GapBias, normalise
from arcade_torch.tools.analysis.pixel_saliency import episode_saliency
from arcade_torch.tools.analysis.recall_density import recall_density as density_of
from arcade_torch.tools.figures import contamination, curves, gap_bias, recall_density, saliency
from arcade_torch.tools.figures.style import TWIN_NAMES, agent_colours, drawing, png, svg
from arcade_torch.tools.runs import Runs, is_baseline

FULL, SMALL = (4.9, 3.0), (3.3, 2.3)  # inches; small ones for many tasks
BINS = 8  # parts of an episode, or as many as the shortest episode of a task has frames
DENSITY: Mapping[str, Any] = {"episodes": 16, "cap": 96}
NOISE: Mapping[str, Any] = {"sigmas": (0.3,), "delays": (0, 1, 2, 5, 10, 20), "starts": 32, "cap": 96}
"""Options of `recall_density` and `contamination` for the page; a figure for a paper takes whole episodes, and more."""
SHOW, TRIES = 8, 10  # frames of a saliency strip; episodes that are tried until one has as many
LEVEL_NAMES = {"random": "random", "state": "oracle", "frames": "frames oracle"}
MOST_CELLS = 12  # up to so many (game, twin, agent) are all looked into
MOST_GAMES = MOST_SEEDS = 3

Finals = Mapping[tuple[str, str], Mapping[str, Sequence[float]]]  # (game, twin) -> agent -> final returns of its seeds
Levels = Mapping[str, Mapping[str, float]]  # game -> player -> mean return
Progress = Callable[[str, int, int], None]


class Panel(NamedTuple):
    """A picture, what stands below it, and the task it is of, as ``GAME-TWIN`` (empty where there are several)."""

    picture: str
    caption: str = ""
    task: str = ""


class Section(NamedTuple):
    """Pictures, rows of the table, and what could not be shown."""

    panels: list[Panel]
    rows: list[dict[str, Any]]
    notes: list[str]


class Cell(NamedTuple):
    """An agent on one twin of a game, and the folders of its finished runs, one a seed."""

    agent: str
    game: str
    twin: str
    runs: tuple[Path, ...]


def select_cells(runs: Runs, finals: Finals, baseline: str) -> tuple[list[Cell], str]:
    """The cells that are looked into, and a note on those that are not."""
    groups = runs.groups()
    paths = {task: [run.path for run in group if (run.path / "checkpoints").is_dir()] for task, group in groups.items()}
    bare = len(runs.runs) - sum(map(len, paths.values()))
    notes = [f"{bare} run{'s' * (bare > 1)} without a checkpoint cannot be looked into."] if bare else []
    cells = [Cell(*task, tuple(found[:MOST_SEEDS])) for task, found in paths.items() if found]
    most = max(map(len, paths.values()), default=0)
    seeds = f"the first {MOST_SEEDS} of {most} seeds" if most > MOST_SEEDS else ""
    if len(cells) <= MOST_CELLS:
        return cells, " ".join(notes + ([f"Shown: {seeds} of each agent."] if seeds else []))
    agents, games = representatives(finals, baseline)
    out_of = f"{len({cell.agent for cell in cells})} agents and {len({cell.game for cell in cells})} games"
    notes.append(
        f"Shown: {' and '.join(agents)} on {', '.join(games)}{', ' + seeds if seeds else ''}, out of {out_of}: the "
        "memory with the highest mean return where observations are partial, beside the memory-free agent, on the "
        "games where it is furthest ahead. Others: arcade-torch figure NAME --runs STUDY."
    )
    return [cell for cell in cells if cell.agent in agents and cell.game in games], " ".join(notes)


def representatives(finals: Finals, baseline: str) -> tuple[list[str], list[str]]:
    """A memory-free agent (if there is one), the best agent with memory, and the games that tell them apart.

    Example:
        >>> representatives({("A", "partial"): {"mlp": [0.1], "lru": [0.9]}, ("B", "partial"): {"mlp": [0.5]}}, "mlp")
        (['mlp', 'lru'], ['A'])
    """
    twin = "partial" if any(seen == "partial" for _, seen in finals) else "full"
    means = {
        game: {agent: fmean([normalise(game, float(value)) for value in values]) for agent, values in agents.items()}
        for (game, seen), agents in finals.items()
        if seen == twin
    }
    everybody = dict.fromkeys(agent for found in means.values() for agent in found)
    free = [agent for agent in everybody if is_baseline(agent, baseline)]
    strength = {agent: fmean([found[agent] for found in means.values() if agent in found]) for agent in everybody}
    best = sorted((agent for agent in everybody if agent not in free), key=lambda agent: -strength[agent])
    pair = [*free[:1], *(best[:1])]
    there = [game for game, found in means.items() if all(agent in found for agent in pair)]
    there.sort(key=lambda game: means[game][pair[0]] - means[game][pair[-1]])
    return pair, there[:MOST_GAMES]


def curve_panels(runs: Runs, kind: str, levels: Levels, agents: Sequence[str], small: bool) -> list[Panel]:
    """One picture a task; the twins of a game share their y axis."""
    every, panels = curves.curves_of_runs(runs.groups(), kind), []
    for game, twin in dict.fromkeys((curve.game, curve.observability) for curve in every):
        here = [curve for curve in every if (curve.game, curve.observability) == (game, twin)]
        seen = np.concatenate([curve.seeds.ravel() for curve in every if curve.game == game])
        means = levels.get(game, {})
        low, high = min([seen.min(), *means.values()]), max([seen.max(), *means.values()])
        margin = 0.07 * (high - low) or 0.5
        shown: dict[str, float] = {}
        for player, mean in means.items():
            if (player, twin) != ("frames", "full"):  # lines that lie on one another share a label
                near = next((name for name, at in shown.items() if abs(at - mean) < 2 * margin), None)
                name = LEVEL_NAMES[player]
                shown |= {name: mean} if near is None else {f"{near}, {name}": shown.pop(near)}
        with drawing("light") as plt:
            figure, axis = plt.subplots(figsize=SMALL if small else FULL, layout="constrained")
            curves.plot(here, axis, agents, shown)
            axis.set(ylim=(low - margin, high + margin), title=f"{game}, {TWIN_NAMES[twin]}")
            drawn = svg(figure, f"{kind} {game}, {TWIN_NAMES[twin]}")
        counts = sorted({len(curve.seeds) for curve in here})
        seeds = " or ".join(map(str, counts)) + (" seed" if counts == [1] else " seeds")
        caption = f"mean of {seeds}" + ("; band: interval over seeds" if counts != [1] else "")
        panels.append(Panel(drawn, "" if small else caption, f"{game}-{twin}"))
    return panels


def score_panels(table: GapBias) -> list[Panel]:
    """Normalised returns on both twins, Gap and Bias."""
    panels = []
    for name in gap_bias.PANELS:
        with drawing("light") as plt:
            figure, axis = plt.subplots(figsize=FULL, layout="constrained")
            gap_bias.plot_bars(table.rows, axis, name)
            panels.append(Panel(svg(figure, name)))
    return panels


def saliency_strips(cells: Sequence[Cell], progress: Progress | None) -> list[dict[str, Any]]:
    """Frames under heat of every cell, from its first seed; with the value drawn brightest and the last share (%)."""
    strips = []
    for done, cell in enumerate(cells, start=1):
        _, found = measure_run(cell.runs[0], episode_saliency, {"show": SHOW, "tries": TRIES})
        frames, shares = found.frames, 100 * found.shares()
        count = min(SHOW, len(frames))
        with drawing("light") as plt:
            figure = plt.figure(figsize=(4.8, 1.4 * -(-count // 4)), layout="constrained")
            axes = figure.subplots(-(-count // 4), 4, squeeze=False).flatten()
            for axis in axes[count:]:
                axis.set_axis_off()
            peak = saliency.plot(frames, found.maps, axes[:count], below=shares)
            source = "data:image/png;base64," + b64encode(png(figure)).decode("ascii")
        last = float(shares[-1])
        strips.append({"cell": cell, "source": source, "frames": len(frames), "peak": peak, "last_share": last})
        if progress is not None:
            progress("saliency", done, len(cells))
    return strips


def recall_section(cells: Sequence[Cell], agents: Sequence[str], progress: Progress | None) -> Section:
    """Recall density of every cell, a picture a task; numbers are kept in the run folders."""

    def measure(cell: Cell, tell: Any) -> tuple[Any, dict[str, Any]]:
        found = [measure_run(path, density_of, DENSITY, None, tell)[1] for path in cell.runs]
        found = [density for density in found if density.shares]
        if not found:
            raise ValueError("no episode of three frames")
        shares = [share for density in found for share in density.shares]
        row = {"seeds": len(found), "episodes": len(shares), "length": np.mean([s.size for s in shares])}
        row |= {"last": np.mean([s[-1] for s in shares]), "first": np.mean([s[0] for s in shares])}
        return found, row | {"older": np.mean([density.mass(2)[0] for density in found])}

    def plot(here: Mapping[str, Any], axis: Any) -> None:
        bins = min(BINS, *(int(density.lengths.min()) for found in here.values() for density in found))
        colours = agent_colours(agents)
        masses = {agent: pooled([density.mass(bins) for density in found]) for agent, found in here.items()}
        recall_density.plot({agent: (mass, colours[agent]) for agent, mass in masses.items()}, axis, bins)
        axis.set_xlabel("time in the episode (1: the decision)")

    return _section(("recall density", "recall"), cells, measure, plot, progress)


def contamination_section(cells: Sequence[Cell], agents: Sequence[str], progress: Progress | None) -> Section:
    """Share of decisions that one noisy frame changes, by delay; a picture a task."""

    def measure(cell: Cell, tell: Any) -> tuple[Any, dict[str, Any]]:
        measured = [measure_run(path, noise, NOISE, None, tell) for path in cell.runs]
        found = [one for _, one in measured]
        (every,) = contamination.pool(by_task(measured)).values()
        flips = np.array([item.mean("flip")[0] for item in found])
        later = np.concatenate([item.flip[:, 0, 1:].ravel() for item in found])
        row: dict[str, Any] = {"seeds": len(found), "points": sum(len(item.points) for item in found)}
        row |= {"change": every["change"].mean[0, 1], "at_once": _mean(flips[:, 0])}
        return every, row | {"one": _mean(flips[:, 1]), "later": _mean(later)}

    def plot(here: Mapping[str, Any], axis: Any) -> None:
        delays = NOISE["delays"][: contamination.reached(here.values())]
        contamination.plot(here, axis, "flip", 0, delays, agent_colours(agents))
        contamination.from_zero(axis)
        axis.set_xlabel("steps after the noisy frame")

    return _section(("contamination", "noise"), cells, measure, plot, progress)


def _section(
    names: tuple[str, str],
    cells: Sequence[Cell],
    measure: Callable[[Cell, Any], tuple[Any, dict[str, Any]]],
    plot: Callable[[Mapping[str, Any], Any], None],
    progress: Progress | None,
) -> Section:
    """Measure every cell for a row of the table, and draw the agents of each task in one picture."""
    made, tasks = Section([], [], []), dict[tuple[str, str], dict[str, Any]]()
    for cell in cells:
        who, twin = f"{cell.agent} on {cell.game}", TWIN_NAMES[cell.twin]
        try:
            found, row = measure(cell, partial(progress, f"{names[0]}, {who}") if progress else None)
        except ValueError as error:  # episodes too short
            made.notes.append(f"{who} {twin}: {error}")
            continue
        tasks.setdefault((cell.game, cell.twin), {})[cell.agent] = found
        made.rows.append({"agent": cell.agent, "game": cell.game, "twin": twin} | row)
    for (game, twin), here in tasks.items():
        with drawing("light") as plt:
            figure, axis = plt.subplots(figsize=SMALL, layout="constrained")
            plot(here, axis)
            axis.set_title(title := f"{game}, {TWIN_NAMES[twin]}")
            made.panels.append(Panel(svg(figure, f"{names[1]} {title}"), "", f"{game}-{twin}"))
    return made


def _mean(values: Any) -> float:
    """Mean of what is not NaN; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")
