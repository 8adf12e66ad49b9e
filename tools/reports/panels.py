"""The pictures of the page: every one is a figure of `arcade_torch.tools.figures`, as SVG or PNG.

All agents of a small study are looked into, and of a large one a few that stand for the rest.
"""

import math
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from arcade_torch.tools.analysis import contamination as noise
from arcade_torch.tools.analysis import recall_density as recall
from arcade_torch.tools.analysis.bootstrap import pooled
from arcade_torch.tools.analysis.checkpoints import by_task, measure_run
from arcade_torch.tools.analysis.gap_bias import GapBias, normalise
from arcade_torch.tools.analysis.pixel_saliency import episode_saliency
from arcade_torch.tools.comparable import Runs
from arcade_torch.tools.figures import (
    Progress,
    contamination,
    gap_bias,
    logs,
    recall_density,
    saliency,
    style,
)
from arcade_torch.tools.figures.style import TWIN_NAMES, agent_colours
from arcade_torch.tools.names import memory_free

# inches; small ones for many tasks
FULL = (4.9, 3.0)
SMALL = (3.3, 2.3)
BINS = 8  # parts of an episode, or as many as the shortest episode of a task has frames
DENSITY: Mapping[str, Any] = {"episodes": 16, "cap": 96}
NOISE: Mapping[str, Any] = {
    "sigmas": (0.3,),
    "delays": (0, 1, 2, 5, 10, 20),
    "starts": 32,
    "cap": 96,
}
"""Options of `recall_density` and `contamination` for the page; a figure for a paper takes whole
episodes, and more.
"""
# frames of a saliency strip; episodes that are tried until one has as many
SHOW = 8
TRIES = 10
LEVEL_NAMES = {"random": "random", "state": "oracle", "frames": "frames oracle"}
MOST_CELLS = 12  # up to so many (game, twin, agent) are all looked into
MOST_GAMES = MOST_SEEDS = 3

# (game, twin) -> agent -> final returns of its seeds
Finals = Mapping[tuple[str, str], Mapping[str, Sequence[float]]]
Levels = Mapping[str, Mapping[str, float]]  # game -> player -> mean return
# (agent, game, twin) -> folders of its finished runs
Cells = Mapping[tuple[str, str, str], Sequence[Path]]


def select_cells(runs: Runs, finals: Finals, baseline: str) -> tuple[Cells, str]:
    """The cells that are looked into, and a note on those that are not."""
    cells = dict[tuple[str, str, str], list[Path]]()
    bare = 0
    most_seeds = 0
    for task, group in runs.groups().items():
        paths = [run.path for run in group if (run.path / "checkpoints").is_dir()]
        bare += len(group) - len(paths)
        most_seeds = max(most_seeds, len(paths))
        if paths:
            cells[task] = paths[:MOST_SEEDS]
    notes = list[str]()
    if bare:
        notes.append(f"{bare} run{'s' * (bare > 1)} without a checkpoint cannot be looked into.")
    seeds = f"the first {MOST_SEEDS} of {most_seeds} seeds" if most_seeds > MOST_SEEDS else ""
    if len(cells) <= MOST_CELLS:
        if seeds:
            notes.append(f"Shown: {seeds} of each agent.")
        return cells, " ".join(notes)
    agents, games = representatives(finals, baseline)
    all_agents = {agent for agent, _, _ in cells}
    all_games = {game for _, game, _ in cells}
    selection = f"{' and '.join(agents)} on {', '.join(games)}"
    if seeds:
        selection += f", {seeds}"
    notes.append(
        f"Shown: {selection}, out of {len(all_agents)} agents and {len(all_games)} games: the "
        "memory with the highest mean return where observations are partial, beside the "
        "memory-free agent, on the "
        "games where it is furthest ahead. Others: arcade-torch figure NAME --runs STUDY."
    )
    selected = {}
    for task, paths in cells.items():
        agent, game, _ = task
        if agent in agents and game in games:
            selected[task] = paths
    return selected, " ".join(notes)


def representatives(finals: Finals, baseline: str) -> tuple[list[str], list[str]]:
    """A memory-free agent (if there is one), the best agent with memory, and the games that tell
    them apart.

    Example:
        >>> both = {("A", "partial"): {"mlp": [0.1], "lru": [0.9]}}
        >>> representatives({**both, ("B", "partial"): {"mlp": [0.5]}}, "mlp")
        (['mlp', 'lru'], ['A'])
    """
    twin = "partial" if any(name == "partial" for _, name in finals) else "full"
    means: dict[str, dict[str, float]] = {}  # game -> agent -> normalised return
    returns: dict[str, list[float]] = {}  # agent -> normalised returns, one a game
    for (game, name), agents in finals.items():
        if name != twin:
            continue
        means[game] = {}
        for agent, values in agents.items():
            mean = fmean([normalise(game, float(value)) for value in values])
            means[game][agent] = mean
            returns.setdefault(agent, []).append(mean)
    free = [agent for agent in returns if memory_free(agent, baseline)]
    remembering = [agent for agent in returns if agent not in free]
    remembering.sort(key=lambda agent: -fmean(returns[agent]))
    pair = [*free[:1], *remembering[:1]]
    games = [game for game, agents in means.items() if set(pair) <= set(agents)]
    games.sort(key=lambda game: means[game][pair[0]] - means[game][pair[-1]])
    return pair, games[:MOST_GAMES]


def curve_panels(
    runs: Runs, kind: str, levels: Levels, agents: Sequence[str], small: bool
) -> list[dict[str, str]]:
    """One picture a task, with what stands below it; the twins of a game share their y axis."""
    curves = logs.curves_of_runs(runs.groups(), kind)
    returns_of_game: dict[str, list[float]] = {}
    for (_, game, _), curve in curves.items():
        returns_of_game.setdefault(game, []).extend(curve.returns.seeds.flat)
    panels = []
    for (game, twin), by_agent in style.agents_by_task(curves).items():
        means = levels.get(game, {})
        inside = [*returns_of_game[game], *means.values()]
        low = min(inside)
        high = max(inside)
        margin = 0.07 * (high - low) or 0.5
        figure, axes = style.panels(1, 1, SMALL if small else FULL)
        axis = axes[0, 0]
        logs.plot(by_agent, axis, agents, _named_levels(means, twin, 2 * margin))
        axis.set(ylim=(low - margin, high + margin), title=f"{game}, {TWIN_NAMES[twin]}")
        picture = style.svg(figure, f"{kind} {game}, {TWIN_NAMES[twin]}")
        caption = "" if small else _curve_caption(list(by_agent.values()))
        panels.append({"picture": picture, "caption": caption, "task": f"{game}-{twin}"})
    return panels


def _named_levels(means: Mapping[str, float], twin: str, apart: float) -> dict[str, float]:
    """Name the lines of the players; lines less than ``apart`` from each other share one."""
    levels = dict[str, float]()
    for player, mean in means.items():
        if (player, twin) == ("frames", "full"):
            continue  # on the MDP it sees what the other oracle sees
        name = LEVEL_NAMES[player]
        close = [label for label, level in levels.items() if abs(level - mean) < apart]
        if close:
            levels[f"{close[0]}, {name}"] = levels.pop(close[0])
        else:
            levels[name] = mean
    return levels


def _curve_caption(curves: Sequence[logs.Curve]) -> str:
    """How many seeds are behind the curves of a panel."""
    counts = sorted({len(curve.returns.seeds) for curve in curves})
    if counts == [1]:
        return "mean of 1 seed"
    return f"mean of {' or '.join(map(str, counts))} seeds; band: interval over seeds"


def score_panels(table: GapBias) -> list[str]:
    """Pictures of normalised returns on both twins, Gap and Bias."""
    pictures = []
    for name in gap_bias.PANELS:
        figure, axes = style.panels(1, 1, FULL)
        gap_bias.plot_bars(table.rows, axes[0, 0], name)
        pictures.append(style.svg(figure, name))
    return pictures


def saliency_strips(cells: Cells, progress: Progress | None) -> list[dict[str, Any]]:
    """Frames under heat of every cell, from its first seed; with the value drawn brightest and the
    last share (%).
    """
    strips = []
    for done, ((agent, game, twin), paths) in enumerate(cells.items(), start=1):
        _, episode = measure_run(paths[0], episode_saliency, {"show": SHOW, "tries": TRIES})
        shares = 100 * episode.shares()
        count = min(SHOW, len(episode.frames))
        lines = math.ceil(count / 4)
        figure, axes = style.panels(lines, 4, (4.8, 1.4 * lines))
        for axis in axes.flat[count:]:
            axis.set_axis_off()
        peak = saliency.plot(episode.frames, episode.maps, axes.flat[:count], below=shares)
        strips.append(
            {
                "agent": agent,
                "game": game,
                "twin": twin,
                "frames": len(shares),
                "last_share": shares[-1],
                "peak": peak,
                "source": b64encode(style.png(figure)).decode("ascii"),
            }
        )
        if progress is not None:
            progress("saliency", done, len(cells))
    return strips


def recall_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None
) -> dict[str, Any]:
    """Recall density of every cell, a picture a task; numbers are kept in the run folders."""
    colours = agent_colours(agents)

    def plot(by_agent: Mapping[str, Sequence[recall.RecallDensity]], axis: Any) -> None:
        shortest = min(_shortest(densities) for densities in by_agent.values())
        bins = min(BINS, shortest)
        series = {}
        for agent, densities in by_agent.items():
            mass = pooled([density.mass(bins) for density in densities])
            series[agent] = (mass, colours[agent])
        recall_density.plot(series, axis, bins)
        axis.set_xlabel("time in the episode (1: the decision)")

    measure = (recall.recall_density, DENSITY)
    return _section("recall density", cells, measure, _recall_row, plot, progress)


def _shortest(densities: Sequence[recall.RecallDensity]) -> int:
    """The number of frames of the shortest trajectory."""
    return min(int(density.lengths.min()) for density in densities)


def _recall_row(
    measured: Sequence[tuple[Any, recall.RecallDensity]],
) -> tuple[list[recall.RecallDensity], dict[str, Any]]:
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


def contamination_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None
) -> dict[str, Any]:
    """Share of decisions that one noisy frame changes, by delay; a picture a task."""
    colours = agent_colours(agents)

    def plot(by_agent: Mapping[str, contamination.Measures], axis: Any) -> None:
        delays = NOISE["delays"][: contamination.reached(by_agent.values())]
        contamination.plot(by_agent, axis, "flip", 0, delays, colours)
        contamination.from_zero(axis)
        axis.set_xlabel("steps after the noisy frame")

    measure = (noise.contamination, NOISE)
    return _section("contamination", cells, measure, _contamination_row, plot, progress)


def _contamination_row(
    measured: Sequence[tuple[Any, noise.Contamination]],
) -> tuple[contamination.Measures, dict[str, Any]]:
    """The measures of one cell pooled over its seeds, and its row of the table."""
    measures = next(iter(contamination.pool(by_task(measured)).values()))
    seeds = [seed for _, seed in measured]
    later = np.concatenate([seed.flip[:, 0, 1:].ravel() for seed in seeds])
    flip = measures["flip"].mean[0]
    row = {
        "seeds": len(seeds),
        "points": sum(len(seed.points) for seed in seeds),
        "at_once": flip[0],
        "one": flip[1],
        "later": float(np.ma.filled(np.ma.masked_invalid(later).mean(), np.nan)),
        "change": measures["change"].mean[0, 1],
    }
    return measures, row


def _section(
    name: str,
    cells: Cells,
    measure: tuple[Callable[..., Any], Mapping[str, Any]],
    summary: Callable[[Any], tuple[Any, dict[str, Any]]],
    plot: Callable[[Any, Any], None],
    progress: Progress | None,
) -> dict[str, Any]:
    """Measure every cell for a row of the table, and draw the agents of each task in one picture;
    notes on the rest.
    """
    pictures = list[str]()
    rows = list[dict[str, Any]]()
    notes = list[str]()
    drawn = dict[tuple[str, str, str], Any]()
    for (agent, game, twin), paths in cells.items():
        tell = partial(progress, f"{name}, {agent} on {game}") if progress else None
        try:
            measured = [measure_run(path, *measure, tell) for path in paths]
            drawn[agent, game, twin], row = summary(measured)
        except ValueError as error:  # episodes too short
            notes.append(f"{agent} on {game} {TWIN_NAMES[twin]}: {error}")
        else:
            rows.append({"agent": agent, "game": game, "twin": TWIN_NAMES[twin]} | row)
    for (game, twin), by_agent in style.agents_by_task(drawn).items():
        figure, axes = style.panels(1, 1, SMALL)
        axis = axes[0, 0]
        plot(by_agent, axis)
        title = f"{game}, {TWIN_NAMES[twin]}"
        axis.set_title(title)
        pictures.append(style.svg(figure, f"{name} {title}"))
    return {"pictures": pictures, "rows": rows, "notes": notes}
