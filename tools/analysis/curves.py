"""Learning curves of agents, with intervals over seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, Pooled, over_seeds
from arcade_torch.tools.runs import Run

POINTS = 120
"""Points of a training curve."""


@dataclass(frozen=True)
class Curve(Pooled):
    """One agent on one task: returns at some frames, pooled over seeds."""

    agent: str
    game: str
    observability: str
    frames: Array


def curves_of_runs(
    groups: Mapping[tuple[str, str, str], Sequence[Run]], kind: str = "eval", confidence: float = 0.95
) -> list[Curve]:
    """Curves of groups of run folders.

    Args:
        groups: (agent, game, observability) -> its runs, one a seed.
        kind: ``eval`` (greedy evaluations) or ``train`` (running mean of training returns, exploration included).
        confidence: of the intervals: percentile bootstrap over seeds.

    Returns:
        One curve a group whose runs have logged something at frames that all of them reached.
    """
    found = []
    for task, runs in groups.items():
        histories = [history for run in runs if (history := _history(run, kind))[0].size]
        if not histories:
            continue
        end = min(frames[-1] for frames, _ in histories)
        start = max(frames[0] for frames, _ in histories)
        longest = max((frames for frames, _ in histories), key=len)
        grid = longest[(longest >= start) & (longest <= end)] if kind == "eval" else np.linspace(start, end, POINTS)
        if grid.size:
            seeds = np.array([np.interp(grid, frames, values) for frames, values in histories])
            found.append(Curve(seeds, *over_seeds(seeds, confidence), *task, grid))
    return found


def _history(run: Run, kind: str) -> tuple[Array, Array]:
    name, column = ("eval.csv", "mean") if kind == "eval" else ("metrics.csv", "train_return_ewm")
    rows = [row for row in run.table(name) if row.get(column)]
    try:
        frames = np.array([float(row["frames"]) for row in rows])
        return frames, np.array([float(row[column]) for row in rows])
    except ValueError as error:
        raise ValueError(f"{run.path / name} is damaged: {error}") from None
