"""Observability Gap and Memory Bias.

``Gap(f) = J(f, MDP) - J(f, POMDP)``: what partial observability costs agent f; small is good.
``Bias(f) = J(f, MDP) - J(no memory, MDP)``: what memory costs where it is not needed; negative is a cost.
J is the normalised return, averaged over tasks.

Source: POPGym Arcade (ICML 2026), definitions of Gap and Bias. Intervals: stratified bootstrap over seeds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import (
    Array,
    Interval,
    iqm,
    mean_over_tasks,
    measured_coverage,
    percentile_interval,
    resampled,
)
from arcade_torch.tools.analysis.normalise import game_of, normalise
from arcade_torch.tools.runs import Score, Source, find_baseline, read_scores

TWINS = ("full", "partial")


@dataclass(frozen=True)
class AgentRow:
    """One agent of the table.

    Attributes:
        agent: its name.
        seeds: smallest number of seeds behind any of its cells.
        mdp_raw: return on the MDPs, mean over tasks.
        pomdp_raw: return on the POMDPs.
        mdp: the same, normalised to [0, 1] task by task.
        pomdp: the same, normalised.
        gap: mdp - pomdp.
        bias: mdp - mdp of the memory-free agent.
        coverage: measured coverage of the interval of Gap; NaN where there is no interval.
        mdp_iqm: interquartile mean of the normalised returns of all MDP runs.
        pomdp_iqm: the same of the POMDP runs.
    """

    agent: str
    seeds: int
    mdp_raw: Interval
    pomdp_raw: Interval
    mdp: Interval
    pomdp: Interval
    gap: Interval
    bias: Interval
    coverage: float
    mdp_iqm: Interval
    pomdp_iqm: Interval


@dataclass(frozen=True)
class GapBias:
    """Table of Gap and Bias.

    Attributes:
        rows: one an agent, in the order in which agents were met, the memory-free one first.
        tasks: environment ids over which the means go: those that every agent has on both twins.
        dropped: environment ids left out because some agent lacks them.
        metric: what the score of a run is.
        baseline: the memory-free agent.
        confidence: nominal confidence of the intervals.
        draws: bootstrap draws.
        without: the same rows leaving out one game (all its difficulties), by game; empty for a single game.
    """

    rows: tuple[AgentRow, ...]
    tasks: tuple[str, ...]
    dropped: tuple[str, ...]
    metric: str
    baseline: str
    confidence: float
    draws: int
    without: Mapping[str, tuple[AgentRow, ...]] = field(default_factory=dict)
    _draws: Mapping[tuple[str, str], Array] = field(default_factory=dict, repr=False)

    def row(self, agent: str) -> AgentRow:
        """The row of an agent."""
        for row in self.rows:
            if row.agent == agent:
                return row
        raise ValueError(f"no agent {agent!r}; there are {', '.join(row.agent for row in self.rows)}")

    def gap_difference(self, first: str, second: str) -> Interval:
        """Gap(first) - Gap(second) with an interval from the same draws."""
        return self._difference("gap", first, second)

    def pomdp_difference(self, first: str, second: str) -> Interval:
        """Normalised POMDP return of first minus that of second."""
        return self._difference("pomdp", first, second)

    def _difference(self, name: str, first: str, second: str) -> Interval:
        a, b = (getattr(self.row(agent), name) for agent in (first, second))
        draws = self._draws[first, name] - self._draws[second, name]
        return percentile_interval(a.value - b.value, draws, self.confidence, not np.isnan(a.low + b.low))

    def table(self) -> list[dict[str, Any]]:
        """Plain rows, for a CSV file; games left out stand in column ``without``."""
        found = [_plain(row, "") for row in self.rows]
        return found + [_plain(row, game) for game, rows in self.without.items() for row in rows]


def gap_and_bias(
    runs: Source,
    *,
    metric: str = "eval_final",
    baseline: str = "mlp",
    draws: int = 10_000,
    confidence: float = 0.95,
    seed: int = 0,
) -> GapBias:
    """Observability Gap and Memory Bias of every agent, with bootstrap intervals.

    Seeds are resampled with replacement within each (agent, task, observability). Gap and Bias of one agent use the
    same resample of its MDP runs, so that their covariance is kept; MDP and POMDP seeds are never paired.

    Args:
        runs: a study's folder, run folders, a CSV file, or scores; see `arcade_torch.tools.runs.read_scores`.
        metric: ``eval_final`` (greedy) or ``train_max_ewm`` (the paper's).
        baseline: the memory-free agent (any case).
        draws: bootstrap draws.
        confidence: of the intervals, in (0, 1).
        seed: of the draws.

    Returns:
        The table.

    Raises:
        ValueError: no agent is complete on any task, the baseline is missing, or an argument is out of range.
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie between 0 and 1, got {confidence}")
    if draws < 1:
        raise ValueError(f"draws must be at least 1, got {draws}")
    cells = _cells(read_scores(runs, metric))
    agents = list(dict.fromkeys(agent for agent, _, _ in cells))
    base = find_baseline(agents, baseline)
    if base is None:
        raise ValueError(f"no scores for the memory-free agent {baseline!r}; there are {', '.join(agents) or 'none'}")
    agents = [base, *(agent for agent in agents if agent != base)]
    every = list(dict.fromkeys(game for _, game, _ in cells))
    tasks = [game for game in every if all((agent, game, twin) in cells for agent in agents for twin in TWINS)]
    if not tasks:
        raise ValueError("no task has finished runs of every agent on both twins: nothing to compare yet")
    rows, kept = _rows(cells, agents, tasks, draws, confidence, seed)
    games = list(dict.fromkeys(game_of(task) for task in tasks))
    without = {}
    for game in games if len(games) > 1 else []:
        rest = [task for task in tasks if game_of(task) != game]
        without[game] = _rows(cells, agents, rest, draws, confidence, seed, with_iqm=False)[0]
    dropped = tuple(game for game in every if game not in tasks)
    return GapBias(rows, tuple(tasks), dropped, metric, base, confidence, draws, without, kept)


Cells = dict[tuple[str, str, str], Array]


def _cells(scores: Sequence[Score]) -> Cells:
    found: dict[tuple[str, str, str], list[tuple[int, float]]] = {}
    for score in scores:
        if score.observability not in TWINS:
            raise ValueError(f"observability must be full or partial, got {score.observability!r}")
        if not np.isfinite(score.value):
            raise ValueError(f"the score of {score.agent} on {score.game}, seed {score.seed}, is {score.value}")
        found.setdefault((score.agent, score.game, score.observability), []).append((score.seed, score.value))
    return {key: np.array([value for _, value in sorted(pairs)]) for key, pairs in found.items()}


def _rows(
    cells: Cells,
    agents: Sequence[str],
    tasks: Sequence[str],
    draws: int,
    confidence: float,
    seed: int,
    with_iqm: bool = True,
) -> tuple[tuple[AgentRow, ...], dict[tuple[str, str], Array]]:
    """A row an agent, the memory-free one first; and (agent, ``gap`` or ``pomdp``) -> draws."""
    found: dict[tuple[str, str], dict[str, tuple[float, Array]]] = {}  # values and draws
    for i, agent in enumerate(agents):
        for j, twin in enumerate(TWINS):
            raw = [cells[agent, task, twin] for task in tasks]
            drawn_raw = resampled(raw, draws, np.random.default_rng([seed, i, j]))
            scaled, drawn = (
                [normalise(task, each) for task, each in zip(tasks, every, strict=True)] for every in (raw, drawn_raw)
            )
            found[agent, twin] = {
                "raw": (_mean(raw), mean_over_tasks(drawn_raw)),
                "mean": (_mean(scaled), mean_over_tasks(drawn)),
                "iqm": (float(iqm(scaled)), iqm(drawn) if with_iqm else np.full(1, np.nan)),
            }
    counts = {key: tuple(len(cells[key[0], task, key[1]]) for task in tasks) for key in found}
    rows, kept = list[AgentRow](), dict[tuple[str, str], Array]()
    free, free_seeds = found[agents[0], "full"]["mean"], min(counts[agents[0], "full"])
    for agent in agents:
        full, partial = found[agent, "full"], found[agent, "partial"]
        seeds = min(counts[agent, "full"] + counts[agent, "partial"])
        kept[agent, "gap"], kept[agent, "pomdp"] = full["mean"][1] - partial["mean"][1], partial["mean"][1]
        values = {"mdp_raw": full["raw"], "pomdp_raw": partial["raw"], "mdp": full["mean"], "pomdp": partial["mean"]}
        values |= {"mdp_iqm": full["iqm"], "pomdp_iqm": partial["iqm"]}
        values["gap"] = (full["mean"][0] - partial["mean"][0], kept[agent, "gap"])
        intervals = {name: percentile_interval(*pair, confidence, seeds > 1) for name, pair in values.items()}
        bias = full["mean"][0] - free[0], full["mean"][1] - free[1]
        intervals["bias"] = percentile_interval(*bias, confidence, min(seeds, free_seeds) > 1)
        both = counts[agent, "full"], counts[agent, "partial"]
        coverage = measured_coverage(*both, confidence) if seeds > 1 else float("nan")
        rows.append(AgentRow(agent, seeds, coverage=coverage, **intervals))
    return tuple(rows), kept


def _mean(cells: Sequence[Array]) -> float:
    return float(np.mean([cell.mean() for cell in cells]))


def _plain(row: AgentRow, without: str) -> dict[str, Any]:
    values: dict[str, Any] = {"agent": row.agent, "without": without, "seeds": row.seeds}
    for name in ("mdp_raw", "pomdp_raw", "mdp", "pomdp", "gap", "bias", "mdp_iqm", "pomdp_iqm"):
        interval: Interval = getattr(row, name)
        values |= {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return values | {"coverage": row.coverage}
