"""Observability Gap and Memory Bias.

``Gap(f) = J(f, MDP) - J(f, POMDP)``: what partial observability costs agent f; small is good.
``Bias(f) = J(f, MDP) - J(no memory, MDP)``: what memory costs where it is not needed; negative is a
cost. J is the normalised return, averaged over tasks; the agent without memory is of the same
algorithm.

Source: POPGym Arcade (ICML 2026), definitions of Gap and Bias. Intervals: stratified bootstrap over
seeds.
"""

import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from arcade_torch.agents.config import require
from arcade_torch.envs_jax.registry import DIFFICULTIES
from arcade_torch.tools.analysis import bootstrap
from arcade_torch.tools.analysis.bootstrap import Array, Interval, percentile_interval
from arcade_torch.tools.names import find_baselines
from arcade_torch.tools.runs import Score
from arcade_torch.tools.scores import Source, read_scores

TWINS = ("full", "partial")
BOTH_TWINS = ("mixed", "both")
NUMBERS = ("mdp_raw", "pomdp_raw", "mdp", "pomdp", "gap", "bias", "mdp_iqm", "pomdp_iqm")
"""Columns of the table that have an interval."""
SIGNED_GAMES = ("BattleShip", "MineSweeper", "Breakout", "Tetris", "Navigator", "Signpost")
"""Games whose returns lie in [-1, 1]; the others' lie in [0, 1] already, and so should those of
your own games.
"""


def game_of(env_id: str) -> str:
    """The game of an environment id, without difficulty and version.

    Example:
        >>> game_of("MineSweeperEasy-v0")
        'MineSweeper'
    """
    game = re.sub(rf"({'|'.join(DIFFICULTIES)})?(-v\d+)?$", "", env_id)
    return "NoisyCartPole" if game in ("NoisyPole", "NoisyCartpole") else game


def normalise(env_id: str, value: Any) -> Any:
    """Map a return, or an array of them, to [0, 1]: (x + 1) / 2 for `SIGNED_GAMES`, x for the
    others.

    Returns outside a game's range stay outside [0, 1]. The id may have its version or not.

    Source: POPGym Arcade (ICML 2026), text on the return figure; the rule gives the aggregates that
    the text quotes.

    Example:
        >>> normalise("TetrisEasy-v0", -0.5), normalise("CartPoleEasy-v0", 0.5)
        (0.25, 0.5)
    """
    return (value + 1) / 2 if game_of(env_id) in SIGNED_GAMES else value


@dataclass(frozen=True)
class AgentRow:
    """One agent of the table; returns are means over tasks."""

    agent: str
    seeds: int  # smallest number of seeds behind any of its cells
    mdp_raw: Interval  # return on the MDPs
    pomdp_raw: Interval
    mdp: Interval  # the same, normalised to [0, 1] task by task
    pomdp: Interval
    gap: Interval  # mdp - pomdp
    bias: Interval  # mdp - mdp of the memory-free agent of its algorithm; NaN where there is none
    coverage: float  # measured coverage of the interval of Gap; NaN where there is no interval
    mdp_iqm: Interval  # interquartile mean of the normalised returns of all MDP runs
    pomdp_iqm: Interval


@dataclass(frozen=True)
class GapBias:
    """Table of Gap and Bias."""

    # one an agent, in the order in which agents were met, memory-free ones first
    rows: tuple[AgentRow, ...]
    # environment ids over which the means go: those that every agent has on both twins
    tasks: tuple[str, ...]
    dropped: tuple[str, ...]  # environment ids left out because some agent lacks them
    metric: str  # what the score of a run is
    baseline: str  # the memory-free agent, of several algorithms the first
    baselines: Mapping[str, str | None]  # agent -> the memory-free agent of its algorithm
    confidence: float  # nominal, of the intervals
    draws: int  # of the bootstrap
    # rows leaving out one game, all its difficulties; empty for one game
    without: Mapping[str, tuple[AgentRow, ...]]
    _values: Mapping[str, Mapping[str, Array]] = field(repr=False)

    def row(self, agent: str) -> AgentRow:
        """The row of an agent."""
        found = {row.agent: row for row in self.rows}
        require(agent in found, "an agent", agent, f"one of {', '.join(found)}")
        return found[agent]

    @property
    def coverage(self) -> dict[int, float]:
        """Fewest seeds -> measured coverage of the intervals of Gap, the smallest of the agents
        with so few.
        """
        known = [(row.seeds, -row.coverage) for row in self.rows if row.coverage == row.coverage]
        return {seeds: -share for seeds, share in sorted(known)}

    def difference(self, name: str, first: str, second: str) -> Interval:
        """A number of the table, such as ``gap``, of one agent minus another's, its interval from
        the same draws.
        """
        known = min(self.row(first).seeds, self.row(second).seeds) > 1
        values = self._values[first][name] - self._values[second][name]
        return percentile_interval(values[0], values[1:], self.confidence, known)

    def table(self) -> list[dict[str, Any]]:
        """Plain rows, for a CSV file; games left out stand in column ``without``."""
        found = []
        for without, rows in {"": self.rows, **self.without}.items():
            for row in rows:
                values: dict[str, Any] = {
                    "agent": row.agent,
                    "without": without,
                    "seeds": row.seeds,
                }
                for name in NUMBERS:
                    values |= zip(
                        (name, f"{name}_low", f"{name}_high"), getattr(row, name), strict=True
                    )
                found.append(values | {"coverage": row.coverage})
        return found


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

    Seeds are resampled with replacement within each (agent, task, observability). Gap and Bias of
    one agent use the same resample of its MDP runs, so that their covariance is kept; MDP and POMDP
    seeds are never paired.

    Args:
        runs: a study's folder, run folders, a CSV file, or scores; see
            `arcade_torch.tools.runs.read_scores`.
        metric: ``eval_final`` (greedy) or ``train_max_ewm`` (the paper's).
        baseline: the memory-free agent (any case); that of one algorithm, ``pqn-mlp``, serves all.
        draws: bootstrap draws.
        confidence: of the intervals, in (0, 1).
        seed: of the draws.

    Returns:
        The table.

    Raises:
        ValueError: no agent is complete on any task, the baseline is missing, or an argument is out
            of range.
    """
    require(0 < confidence < 1, "confidence", confidence, "between 0 and 1")
    require(draws >= 1, "draws", draws, "at least 1")
    cells = _cells(
        [score for score in read_scores(runs, metric) if score.observability not in BOTH_TWINS]
    )
    agents = list(dict.fromkeys(agent for agent, _, _ in cells))
    if not (found := find_baselines(agents, baseline)):
        raise ValueError(
            f"no scores for the memory-free agent {baseline!r}, only for "
            f"{', '.join(agents) or 'nobody'}"
        )
    baselines = {agent: found.get(agent) for agent in [*found.values(), *agents]}
    every = list(dict.fromkeys(game for _, game, _ in cells))
    tasks = [
        game
        for game in every
        if all((agent, game, twin) in cells for agent in agents for twin in TWINS)
    ]
    if not tasks:
        raise ValueError(
            "no task has finished runs of every agent on both twins: nothing to compare yet"
        )
    rows, values = _rows(cells, baselines, tasks, draws, confidence, seed, iqm=True)
    games = list(dict.fromkeys(game_of(task) for task in tasks))
    without = {}
    for game in games if len(games) > 1 else []:
        rest = [task for task in tasks if game_of(task) != game]
        without[game], _ = _rows(cells, baselines, rest, draws, confidence, seed, iqm=False)
    dropped = tuple(game for game in every if game not in tasks)
    return GapBias(
        rows,
        tuple(tasks),
        dropped,
        metric,
        rows[0].agent,
        baselines,
        confidence,
        draws,
        without,
        values,
    )


Cells = dict[tuple[str, str, str], Array]
Baselines = Mapping[str, str | None]


def _cells(scores: Sequence[Score]) -> Cells:
    found: dict[tuple[str, str, str], list[tuple[int, float]]] = {}
    for score in scores:
        require(
            score.observability in TWINS, "observability", score.observability, "full or partial"
        )
        if not np.isfinite(score.value):
            raise ValueError(
                f"the score of {score.agent} on {score.game}, seed {score.seed}, is {score.value}"
            )
        found.setdefault((score.agent, score.game, score.observability), []).append(
            (score.seed, score.value)
        )
    return {key: np.array([value for _, value in sorted(pairs)]) for key, pairs in found.items()}


def _place(task: str) -> tuple[str, int, str]:
    """Where a task stands in the order of games, difficulties and ids."""
    game = game_of(task)
    rest = re.sub(r"-v\d+$", "", task).removeprefix(game)
    return game, DIFFICULTIES.index(rest) if rest in DIFFICULTIES else -1, task


def _generator(seed: int, agent: str, task: str, twin: str) -> np.random.Generator:
    """The draws of a cell: the same whatever else is in the table, and in which order it was
    met.
    """
    game = re.sub(r"-v\d+$", "", task)
    return np.random.default_rng(
        [seed, zlib.crc32(f"{agent}\n{game}\n{twin}".encode(errors="backslashreplace"))]
    )


def _rows(
    cells: Cells,
    baselines: Baselines,
    tasks: Sequence[str],
    draws: int,
    confidence: float,
    seed: int,
    iqm: bool,
) -> tuple[tuple[AgentRow, ...], dict[str, dict[str, Array]]]:
    """A row an agent, and agent -> name in `NUMBERS` -> float64 [1 + draws]: the number itself,
    then its draws.
    """
    rows = list[AgentRow]()
    values = dict[str, dict[str, Array]]()
    # the same sums, to the bit, in whatever order the runs were met
    tasks = sorted(tasks, key=_place)
    for agent, free in baselines.items():
        mine = values.setdefault(agent, {})
        counts = list[tuple[int, ...]]()
        for twin, name in zip(TWINS, ("mdp", "pomdp"), strict=True):
            seeds = [cells[agent, task, twin] for task in tasks]
            drawn = [
                bootstrap.resampled(
                    [cells[agent, task, twin]], draws, _generator(seed, agent, task, twin)
                )[0]
                for task in tasks
            ]
            raw = [np.vstack([first, again]) for first, again in zip(seeds, drawn, strict=True)]
            scaled = [normalise(task, each) for task, each in zip(tasks, raw, strict=True)]
            mine[f"{name}_raw"] = bootstrap.mean_over_tasks(raw)
            mine[name] = bootstrap.mean_over_tasks(scaled)
            mine[f"{name}_iqm"] = bootstrap.iqm(scaled if iqm else [each[:1] for each in scaled])
            counts.append(tuple(map(len, seeds)))
        mine["gap"], mine["bias"] = (
            mine["mdp"] - mine["pomdp"],
            mine["mdp"] - (values[free]["mdp"] if free else np.nan),
        )
        fewest = min(map(min, counts))
        free_seeds = min(len(cells[free or agent, task, "full"]) for task in tasks)
        known = dict.fromkeys(mine, fewest > 1) | {"bias": min(fewest, free_seeds) > 1}
        ends = {
            name: percentile_interval(x[0], x[1:], confidence, known[name])
            for name, x in mine.items()
        }
        coverage = bootstrap.measured_coverage(*counts, confidence) if fewest > 1 else float("nan")
        rows.append(AgentRow(agent, fewest, coverage=coverage, **ends))
    return tuple(rows), values
