"""Learning curves of agents, with intervals over seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.runs import Run

POINTS = 120
"""Points of a training curve."""


@dataclass(frozen=True)
class Curve:
    """One agent on one task, averaged over seeds."""

    agent: str
    game: str
    observability: str
    frames: Array
    mean: Array
    low: Array
    high: Array
    seeds: Array


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
    for (agent, game, twin), runs in groups.items():
        histories = [history for run in runs if (history := _history(run, kind))[0].size]
        if histories and (curve := _curve(agent, game, twin, histories, kind, confidence)).frames.size:
            found.append(curve)
    return found


def _history(run: Run, kind: str) -> tuple[Array, Array]:
    name, column = ("eval.csv", "mean") if kind == "eval" else ("metrics.csv", "train_return_ewm")
    rows = [row for row in run.table(name) if row.get(column)]
    try:
        frames = np.array([float(row["frames"]) for row in rows])
        return frames, np.array([float(row[column]) for row in rows])
    except ValueError as error:
        raise ValueError(f"{run.path / name} is damaged: {error}") from None


def _curve(
    agent: str, game: str, twin: str, histories: Sequence[tuple[Array, Array]], kind: str, confidence: float
) -> Curve:
    end = min(frames[-1] for frames, _ in histories)
    start = max(frames[0] for frames, _ in histories)
    longest = max((frames for frames, _ in histories), key=len)
    grid = longest[(longest >= start) & (longest <= end)] if kind == "eval" else np.linspace(start, end, POINTS)
    seeds = np.array([np.interp(grid, frames, values) for frames, values in histories])
    mean, low, high = over_seeds(seeds, confidence)
    return Curve(agent, game, twin, grid, mean, low, high, seeds)
