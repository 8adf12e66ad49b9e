"""The pictures of the page: every one is a figure of `arcade_torch.tools.figures`, as SVG or PNG.

All agents of a small study are looked into, and of a large one a few that stand for the rest.
"""

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
    groups = runs.groups()
    paths = {
        task: [run.path for run in group if (run.path / "checkpoints").is_dir()]
        for task, group in groups.items()
    }
    bare = len(runs.runs) - sum(map(len, paths.values()))
    notes = (
        [f"{bare} run{'s' * (bare > 1)} without a checkpoint cannot be looked into."]
        if bare
        else []
    )
    cells = {task: found[:MOST_SEEDS] for task, found in paths.items() if found}
    most = max(map(len, paths.values()), default=0)
    seeds = f"the first {MOST_SEEDS} of {most} seeds" if most > MOST_SEEDS else ""
    if len(cells) <= MOST_CELLS:
        return cells, " ".join(notes + ([f"Shown: {seeds} of each agent."] if seeds else []))
    agents, games = representatives(finals, baseline)
    out_of = (
        f"{len({agent for agent, _, _ in cells})} agents and {len({game for _, game, _ in cells})} "
        "games"
    )
    notes.append(
        f"Shown: {' and '.join(agents)} on {', '.join(games)}{', ' + seeds if seeds else ''}, out "
        f"of {out_of}: the "
        "memory with the highest mean return where observations are partial, beside the "
        "memory-free agent, on the "
        "games where it is furthest ahead. Others: arcade-torch figure NAME --runs STUDY."
    )
    return {
        task: found for task, found in cells.items() if task[0] in agents and task[1] in games
    }, " ".join(notes)


def representatives(finals: Finals, baseline: str) -> tuple[list[str], list[str]]:
    """A memory-free agent (if there is one), the best agent with memory, and the games that tell
    them apart.

    Example:
        >>> both = {("A", "partial"): {"mlp": [0.1], "lru": [0.9]}}
        >>> representatives({**both, ("B", "partial"): {"mlp": [0.5]}}, "mlp")
        (['mlp', 'lru'], ['A'])
    """
    twin = "partial" if any(seen == "partial" for _, seen in finals) else "full"
    means = {
        game: {
            agent: fmean([normalise(game, float(value)) for value in values])
            for agent, values in agents.items()
        }
        for (game, seen), agents in finals.items()
        if seen == twin
    }
    everybody = dict.fromkeys(agent for found in means.values() for agent in found)
    free = [agent for agent in everybody if memory_free(agent, baseline)]
    strength = {
        agent: fmean([found[agent] for found in means.values() if agent in found])
        for agent in everybody
    }
    best = sorted(
        (agent for agent in everybody if agent not in free), key=lambda agent: -strength[agent]
    )
    pair = [*free[:1], *(best[:1])]
    there = [game for game, found in means.items() if all(agent in found for agent in pair)]
    there.sort(key=lambda game: means[game][pair[0]] - means[game][pair[-1]])
    return pair, there[:MOST_GAMES]


def curve_panels(
    runs: Runs, kind: str, levels: Levels, agents: Sequence[str], small: bool
) -> list[dict[str, str]]:
    """One picture a task, with what stands below it; the twins of a game share their y axis."""
    every = logs.curves_of_runs(runs.groups(), kind)
    panels = []
    for (game, twin), here in style.agents_by_task(every).items():
        seen = np.concatenate(
            [curve.returns.seeds.ravel() for task, curve in every.items() if task[1] == game]
        )
        means = levels.get(game, {})
        low = min([seen.min(), *means.values()])
        high = max([seen.max(), *means.values()])
        margin = 0.07 * (high - low) or 0.5
        shown: dict[str, float] = {}
        for player, mean in means.items():
            if (player, twin) != ("frames", "full"):  # lines that lie on one another share a label
                near = next(
                    (name for name, at in shown.items() if abs(at - mean) < 2 * margin), None
                )
                name = LEVEL_NAMES[player]
                shown |= {name: mean} if near is None else {f"{near}, {name}": shown.pop(near)}
        figure, ((axis,),) = style.panels(1, 1, SMALL if small else FULL)
        logs.plot(here, axis, agents, shown)
        axis.set(ylim=(low - margin, high + margin), title=f"{game}, {TWIN_NAMES[twin]}")
        counts = sorted({len(curve.returns.seeds) for curve in here.values()})
        seeds = " or ".join(map(str, counts)) + (" seed" if counts == [1] else " seeds")
        caption = f"mean of {seeds}" + ("; band: interval over seeds" if counts != [1] else "")
        picture = style.svg(figure, f"{kind} {game}, {TWIN_NAMES[twin]}")
        panels.append(
            {"picture": picture, "caption": "" if small else caption, "task": f"{game}-{twin}"}
        )
    return panels


def score_panels(table: GapBias) -> list[str]:
    """Pictures of normalised returns on both twins, Gap and Bias."""
    found = []
    for name in gap_bias.PANELS:
        figure, ((axis,),) = style.panels(1, 1, FULL)
        gap_bias.plot_bars(table.rows, axis, name)
        found.append(style.svg(figure, name))
    return found


def saliency_strips(cells: Cells, progress: Progress | None) -> list[dict[str, Any]]:
    """Frames under heat of every cell, from its first seed; with the value drawn brightest and the
    last share (%).
    """
    strips = []
    for done, ((agent, game, twin), paths) in enumerate(cells.items(), start=1):
        _, found = measure_run(paths[0], episode_saliency, {"show": SHOW, "tries": TRIES})
        shares = 100 * found.shares()
        count = min(SHOW, len(found.frames))
        figure, axes = style.panels(-(-count // 4), 4, (4.8, 1.4 * -(-count // 4)))
        for axis in axes.flat[count:]:
            axis.set_axis_off()
        peak = saliency.plot(found.frames, found.maps, axes.flat[:count], below=shares)
        what = {
            "agent": agent,
            "game": game,
            "twin": twin,
            "frames": len(shares),
            "last_share": shares[-1],
        }
        strips.append(what | {"peak": peak, "source": b64encode(style.png(figure)).decode("ascii")})
        if progress is not None:
            progress("saliency", done, len(cells))
    return strips


def recall_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None
) -> dict[str, Any]:
    """Recall density of every cell, a picture a task; numbers are kept in the run folders."""

    def summary(measured: Sequence[tuple[Any, recall.RecallDensity]]) -> tuple[Any, dict[str, Any]]:
        found = [density for _, density in measured if density.shares]
        shares = [share for density in found for share in density.shares]
        if not found:
            raise ValueError("no episode of three frames")
        row = {
            "seeds": len(found),
            "episodes": len(shares),
            "length": np.mean([s.size for s in shares]),
        }
        row |= {"last": np.mean([s[-1] for s in shares]), "first": np.mean([s[0] for s in shares])}
        return found, row | {"older": np.mean([density.mass(2)[0] for density in found])}

    def plot(here: Mapping[str, Any], axis: Any) -> None:
        bins = min(
            BINS, *(int(density.lengths.min()) for found in here.values() for density in found)
        )
        colours = agent_colours(agents)
        masses = {
            agent: pooled([density.mass(bins) for density in found])
            for agent, found in here.items()
        }
        recall_density.plot(
            {agent: (mass, colours[agent]) for agent, mass in masses.items()}, axis, bins
        )
        axis.set_xlabel("time in the episode (1: the decision)")

    return _section(
        "recall density", cells, (recall.recall_density, DENSITY), summary, plot, progress
    )


def contamination_section(
    cells: Cells, agents: Sequence[str], progress: Progress | None
) -> dict[str, Any]:
    """Share of decisions that one noisy frame changes, by delay; a picture a task."""

    def summary(measured: Sequence[tuple[Any, noise.Contamination]]) -> tuple[Any, dict[str, Any]]:
        found = [one for _, one in measured]
        (every,) = contamination.pool(by_task(measured)).values()
        later = np.ma.masked_invalid(
            np.concatenate([item.flip[:, 0, 1:].ravel() for item in found])
        ).mean()
        row = {"seeds": len(found), "points": sum(len(item.points) for item in found)}
        row |= {"at_once": every["flip"].mean[0, 0], "one": every["flip"].mean[0, 1]}
        return every, row | {
            "later": float(np.ma.filled(later, np.nan)),
            "change": every["change"].mean[0, 1],
        }

    def plot(here: Mapping[str, Any], axis: Any) -> None:
        delays = NOISE["delays"][: contamination.reached(here.values())]
        contamination.plot(here, axis, "flip", 0, delays, agent_colours(agents))
        contamination.from_zero(axis)
        axis.set_xlabel("steps after the noisy frame")

    return _section("contamination", cells, (noise.contamination, NOISE), summary, plot, progress)


def _section(
    name: str,
    cells: Cells,
    measure: tuple[Callable[..., Any], Mapping[str, Any]],
    summary: Callable[[Any], tuple[Any, dict[str, Any]]],
    plot: Callable[[Mapping[str, Any], Any], None],
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
    for (game, twin), here in style.agents_by_task(drawn).items():
        figure, ((axis,),) = style.panels(1, 1, SMALL)
        plot(here, axis)
        axis.set_title(title := f"{game}, {TWIN_NAMES[twin]}")
        pictures.append(style.svg(figure, f"{name} {title}"))
    return {"pictures": pictures, "rows": rows, "notes": notes}
