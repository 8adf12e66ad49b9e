"""One agent against every other, task by task and over all: differences of normalised returns.

Positive is in favour of the one. Intervals are those of the bootstrap behind Gap and Bias: seeds
are resampled within each agent, task and twin, with the same draws as there.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.tools.measures.bootstrap import (
    Array,
    Interval,
    mean_over_tasks,
    percentile_interval,
    resampled,
)
from arcade_torch.tools.measures.gap_bias.measure import TWINS, generator_of, normalise
from arcade_torch.tools.runs import Score

DRAWS = 10_000
CONFIDENCE = 0.95

Task = tuple[str, str]  # game and twin
Cells = dict[Task, Array]  # normalised returns of the seeds, then their resamples: [1 + draws, n]


class Pair(NamedTuple):
    """One agent against another on one task, or on the mean of several."""

    game: str  # environment id; empty for the mean over games
    twin: str  # ``full`` or ``partial``; empty for the mean over both
    other: str  # name of the other agent
    seeds: int  # the fewest behind the difference
    subject_return: float  # normalised
    other_return: float
    difference: Interval  # subject_return - other_return


def pairs(scores: Sequence[Score], subject: str, draws: int = DRAWS) -> list[Pair]:
    """Compare an agent with every other on the tasks that both have.

    Args:
        scores: of the runs, with the names of the agents.
        subject: name of the one agent.
        draws: of the bootstrap.

    Returns:
        Task by task, then the mean over the MDPs, over the POMDPs and over both.
    """
    returns: dict[str, dict[Task, list[float]]] = {}
    for score in sorted(scores, key=lambda score: score.seed):
        if score.observability in TWINS:
            task = (score.game, score.observability)
            returns.setdefault(score.agent, {}).setdefault(task, []).append(score.value)
    agents = dict[str, Cells]()
    for name, by_task in returns.items():
        agents[name] = _cells(name, by_task, draws)
    mine = agents.pop(subject, {})
    rows = list[Pair]()
    for game, twin in mine:
        for other, theirs in agents.items():
            rows += _pair(game, twin, other, mine, theirs, [(game, twin)])
    for twin in (*TWINS, ""):
        tasks = [task for task in mine if twin in ("", task[1])]
        for other, theirs in agents.items():
            rows += _pair("", twin, other, mine, theirs, tasks)
    return rows


def _cells(agent: str, returns: Mapping[Task, Sequence[float]], draws: int) -> Cells:
    """The returns of an agent with their resamples."""
    cells = Cells()
    for (game, twin), values in returns.items():
        seeds = np.array(values, dtype=np.float64)
        (drawn,) = resampled([seeds], draws, generator_of(0, agent, game, twin))
        cells[game, twin] = normalise(game, np.vstack([seeds, drawn]))
    return cells


def _pair(
    game: str, twin: str, other: str, mine: Cells, theirs: Cells, tasks: Sequence[Task]
) -> list[Pair]:
    """The row of some tasks; none if the other agent has none of them."""
    my_cells = list[Array]()
    their_cells = list[Array]()
    for task in tasks:
        if task in theirs:
            my_cells.append(mine[task])
            their_cells.append(theirs[task])
    if not my_cells:
        return []
    my_means = mean_over_tasks(my_cells)
    their_means = mean_over_tasks(their_cells)
    differences = my_means - their_means
    seeds = min(cell.shape[1] for cell in (*my_cells, *their_cells))
    interval = percentile_interval(differences[0], differences[1:], CONFIDENCE, seeds > 1)
    return [Pair(game, twin, other, seeds, float(my_means[0]), float(their_means[0]), interval)]


def pair_rows(table: Sequence[Pair], subject: str) -> list[dict[str, Any]]:
    """Plain rows, for a CSV file."""
    rows = []
    for pair in table:
        row: dict[str, Any] = {"subject": subject} | pair._asdict()
        row["difference"] = pair.difference.value
        row["difference_low"] = pair.difference.low
        row["difference_high"] = pair.difference.high
        rows.append(row)
    return rows
