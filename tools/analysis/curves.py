"""Learning curves of the agents of a study, with intervals over seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Array, over_seeds
from arcade_torch.tools.studies.folder import RunFolder, StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study

POINTS = 120
"""Points of a training curve."""


@dataclass(frozen=True)
class Curve:
    """One agent on one task, averaged over seeds.

    Attributes:
        agent: its name.
        game: environment id.
        observability: ``full`` or ``partial``.
        frames: float64 [P].
        mean: float64 [P], mean over seeds.
        low: float64 [P], lower end of the interval (NaN with one seed).
        high: float64 [P], upper end.
        seeds: float64 [n_seeds, P], the single runs.
    """

    agent: str
    game: str
    observability: str
    frames: Array
    mean: Array
    low: Array
    high: Array
    seeds: Array


def agent_name(study: Study, run: RunSpec) -> str:
    """What a run's agent is called in tables: its memory, with the algorithm where there are several."""
    return run.agent if len(study.algorithms) == 1 else f"{run.algorithm}-{run.agent}"


def learning_curves(folder: StudyFolder, study: Study, kind: str = "eval", confidence: float = 0.95) -> list[Curve]:
    """Curves of all agents and tasks.

    Args:
        folder: the study on disk.
        study: what it asks.
        kind: ``eval`` (greedy evaluations) or ``train`` (running mean of training returns, exploration included).
        confidence: of the intervals: percentile bootstrap over seeds.

    Returns:
        One curve an (agent, game, observability) with at least one run, cut to the frames that all its runs reached.
    """
    groups: dict[tuple[str, str, str], list[RunFolder]] = {}
    for run in study.runs():
        groups.setdefault((agent_name(study, run), run.game, run.observability), []).append(folder.run(run))
    return curves_of_runs(groups, kind, confidence)


def curves_of_runs(
    groups: Mapping[tuple[str, str, str], Sequence[RunFolder]], kind: str = "eval", confidence: float = 0.95
) -> list[Curve]:
    """Curves of groups of run folders.

    Args:
        groups: (agent, game, observability) -> its runs, one a seed.
        kind: as for `learning_curves`.
        confidence: as for `learning_curves`.

    Returns:
        One curve a group whose runs have logged something at frames that all of them reached.
    """
    found = []
    for (agent, game, twin), runs in groups.items():
        histories = [history for run in runs if (history := _history(run, kind))[0].size]
        if histories and (curve := _curve(agent, game, twin, histories, kind, confidence)).frames.size:
            found.append(curve)
    return found


def _history(run: RunFolder, kind: str) -> tuple[Array, Array]:
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
