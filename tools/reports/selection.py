"""Which runs are looked into: all of a small study, a few that stand for the rest of a large one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from arcade_torch.tools.analysis.normalise import normalise
from arcade_torch.tools.runs import Runs, is_baseline

MOST_CELLS = 12
"""Up to so many (game, twin, agent) are all looked into."""
MOST_GAMES = 3
MOST_SEEDS = 3

Finals = Mapping[tuple[str, str], Mapping[str, Sequence[float]]]
"""(game, twin) -> agent -> final returns of its finished seeds."""


class Cell(NamedTuple):
    """An agent on one twin of a game, and the folders of its finished runs, one a seed."""

    agent: str
    game: str
    twin: str
    runs: tuple[Path, ...]


def select_cells(runs: Runs, finals: Finals, baseline: str) -> tuple[list[Cell], str]:
    """The cells that are looked into, and a note on those that are not."""
    paths = {
        key: [run.path for run in group if (run.path / "checkpoints").is_dir()] for key, group in runs.groups().items()
    }
    bare = len(runs.runs) - sum(map(len, paths.values()))
    notes = [f"{bare} run{'s' * (bare > 1)} without a checkpoint cannot be looked into."] if bare else []
    cells = [Cell(*key, tuple(found[:MOST_SEEDS])) for key, found in paths.items() if found]
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
        game: {agent: _mean([normalise(game, float(value)) for value in values]) for agent, values in agents.items()}
        for (game, seen), agents in finals.items()
        if seen == twin
    }
    everybody = dict.fromkeys(agent for found in means.values() for agent in found)
    free = [agent for agent in everybody if is_baseline(agent, baseline)]
    strength = {agent: _mean([found[agent] for found in means.values() if agent in found]) for agent in everybody}
    best = sorted((agent for agent in everybody if agent not in free), key=lambda agent: -strength[agent])
    pair = [*free[:1], *(best[:1])]
    there = [game for game, found in means.items() if all(agent in found for agent in pair)]
    there.sort(key=lambda game: means[game][pair[0]] - means[game][pair[-1]])
    return (pair if best else free[:1]), there[:MOST_GAMES]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
