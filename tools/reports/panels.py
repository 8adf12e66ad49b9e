"""Which runs of a study the page looks into, and its learning curves.

All agents of a small study are looked into, and of a large one a few that stand for the rest. The
pictures of a measure stand beside its figure.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

from arcade_torch.tools.comparable import Runs
from arcade_torch.tools.figures import logs, style
from arcade_torch.tools.figures.style import TWIN_NAMES
from arcade_torch.tools.measures.gap_bias.measure import normalise
from arcade_torch.tools.measures.section import Cells
from arcade_torch.tools.names import memory_free

LEVEL_NAMES = {"random": "random", "state": "oracle", "frames": "frames oracle"}
MOST_CELLS = 12  # up to so many (game, twin, agent) are all looked into
MOST_GAMES = MOST_SEEDS = 3

# (game, twin) -> agent -> final returns of its seeds
Finals = Mapping[tuple[str, str], Mapping[str, Sequence[float]]]
Levels = Mapping[str, Mapping[str, float]]  # game -> player -> mean return


def select_cells(runs: Runs, finals: Finals, baseline: str, subject: str = "") -> tuple[Cells, str]:
    """The cells that are looked into, those of the subject among them, and a note on those that are
    not.
    """
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
    all_agents = list(dict.fromkeys(agent for agent, _, _ in cells))
    all_games = list(dict.fromkeys(game for _, game, _ in cells))
    agents = all_agents
    games = all_games
    if len(cells) > MOST_CELLS:
        agents, games = representatives(finals, baseline, subject)
    if (len(agents), len(games)) == (len(all_agents), len(all_games)):
        if seeds:
            notes.append(f"Shown: {seeds} of each agent.")
        return cells, " ".join(notes)
    selection = f"{' and '.join(agents)} on {', '.join(games)}"
    if seeds:
        selection += f", {seeds}"
    best = "the memory with the highest mean return where observations are partial"
    notes.append(
        f"Shown: {selection}, out of {len(all_agents)} agents and {len(all_games)} games: "
        f"{f'{subject}, ' if subject else ''}{best}, beside the memory-free agent, on the games "
        f"where {subject or 'it'} is furthest ahead. Others: arcade-torch figure NAME --runs STUDY."
    )
    selected = {}
    for task, paths in cells.items():
        agent, game, _ = task
        if agent in agents and game in games:
            selected[task] = paths
    return selected, " ".join(notes)


def representatives(
    finals: Finals, baseline: str, subject: str = ""
) -> tuple[list[str], list[str]]:
    """A memory-free agent (if there is one), the best agent with memory, the subject, and the games
    that tell the first and the last apart.

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
    selection = [*free[:1], *remembering[:1]]
    if subject:
        selection = [agent for agent in selection if agent != subject]
        selection.append(subject)
    games = [game for game, agents in means.items() if set(selection) <= set(agents)]
    games.sort(key=lambda game: means[game][selection[0]] - means[game][selection[-1]])
    return selection, games[:MOST_GAMES]


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
        returns = [*returns_of_game[game], *means.values()]
        inside = [value for value in returns if math.isfinite(value)] or [0.0]
        low = min(inside)
        high = max(inside)
        margin = 0.07 * (high - low) or 0.5
        figure, axes = style.panels(1, 1, style.SMALL_PANEL if small else style.PANEL)
        axis = axes[0, 0]
        logs.plot(by_agent, axis, agents, _named_levels(means, twin, 2 * margin))
        axis.set(ylim=(low - margin, high + margin), title=f"{game}, {TWIN_NAMES[twin]}")
        axis.set_ylabel("greedy return" if kind == "eval" else "training return")
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
