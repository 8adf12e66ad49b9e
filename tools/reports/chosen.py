"""Which runs are looked into: all of a small study, a few that stand for the rest of a large one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.curves import agent_name
from arcade_torch.tools.analysis.normalise import normalise
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study

MOST_CELLS = 12
"""Up to so many (game, twin, agent) are all looked into."""

MOST_GAMES = 3
MOST_SEEDS = 3

Finals = Mapping[tuple[str, str], Mapping[str, Sequence[float]]]


@dataclass(frozen=True)
class Cell:
    """An agent on one twin of a game, and the folders of its finished runs, one a seed."""

    agent: str
    game: str
    twin: str
    runs: tuple[Path, ...]


def chosen_cells(
    folder: StudyFolder, study: Study, rows: Sequence[Mapping[str, Any]], finals: Finals
) -> tuple[list[Cell], str]:
    """The cells that memory is looked into.

    Args:
        folder: the study on disk.
        study: what it asks.
        rows: of its results, one a run.
        finals: (game, twin) -> agent -> final returns of its finished seeds.

    Returns:
        The cells, at most `MOST_SEEDS` runs each, and a sentence on what was left out (empty if nothing).
    """
    runs: dict[tuple[str, str, str], list[Path]] = {}
    bare = 0
    for run, row in zip(study.runs(), rows, strict=True):
        path = folder.run(run).path
        if row["status"] != "finished":
            continue
        if (path / "checkpoints").is_dir():
            runs.setdefault((run.game, run.observability, agent_name(study, run)), []).append(path)
        else:
            bare += 1
    notes = [f"{bare} run{'s' * (bare > 1)} without a checkpoint cannot be looked into."] if bare else []
    cells = [Cell(name, game, twin, tuple(paths[:MOST_SEEDS])) for (game, twin, name), paths in runs.items()]
    most = max((len(paths) for paths in runs.values()), default=0)
    seeds = f"the first {MOST_SEEDS} of {most} seeds" if most > MOST_SEEDS else ""
    if len(cells) <= MOST_CELLS:
        return cells, " ".join(notes + ([f"Shown: {seeds} of each agent."] if seeds else []))
    agents, games = representatives(finals, study.baseline)
    shown = [cell for cell in cells if cell.agent in agents and cell.game in games]
    out_of = f"{len({cell.agent for cell in cells})} agents and {len({cell.game for cell in cells})} games"
    notes.append(
        f"Shown: {' and '.join(agents)} on {', '.join(games)}{', ' + seeds if seeds else ''}, out of {out_of}: the "
        "memory with the highest mean return where observations are partial, beside the memory-free agent, on the "
        "games where it is furthest ahead. Others: arcade-torch figure --runs."
    )
    return shown, " ".join(notes)


def representatives(finals: Finals, baseline: str) -> tuple[list[str], list[str]]:
    """A memory-free agent (if there is one), the best agent with memory, and the games that tell them apart.

    Args:
        finals: as for `chosen_cells`.
        baseline: name of the memory-free agent.

    Example:
        >>> representatives({("A", "partial"): {"mlp": [0.1], "lru": [0.9]}, ("B", "partial"): {"mlp": [0.5]}}, "mlp")
        (['mlp', 'lru'], ['A'])
    """
    twin = "partial" if any(key[1] == "partial" for key in finals) else "full"
    means = {
        game: {agent: float(np.mean([normalise(game, float(v)) for v in values])) for agent, values in agents.items()}
        for (game, seen), agents in finals.items()
        if seen == twin
    }
    by_agent: dict[str, list[float]] = {}
    for agents in means.values():
        for agent, mean in agents.items():
            by_agent.setdefault(agent, []).append(mean)
    free = [agent for agent in by_agent if is_baseline(agent, baseline)]
    with_memory = [agent for agent in by_agent if agent not in free]
    best = max(with_memory, key=lambda agent: float(np.mean(by_agent[agent])), default="")
    pair = [*free[:1], best] if best else free[:1]
    there = [game for game, found in means.items() if all(agent in found for agent in pair)]
    there.sort(key=lambda game: means[game][pair[0]] - means[game][pair[-1]] if len(pair) > 1 else 0.0)
    return pair, there[:MOST_GAMES]


def is_baseline(agent: str, baseline: str) -> bool:
    """Whether an agent is the memory-free one, alone or behind the name of an algorithm."""
    return agent == baseline or agent.endswith(f"-{baseline}")
