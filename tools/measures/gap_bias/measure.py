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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from arcade_torch.agents.checked import coerce, require, whole_from
from arcade_torch.envs_jax.registry import DIFFICULTIES, is_mixture
from arcade_torch.tools.measures import bootstrap
from arcade_torch.tools.measures.bootstrap import Array, Interval, percentile_interval
from arcade_torch.tools.names import find_baselines, named_like
from arcade_torch.tools.runs import Score
from arcade_torch.tools.scores import Source, read_scores

MEMORY_FREE = "mlp"
"""The memory-free agent, where none is named."""
TWINS = ("full", "partial")
BOTH_TWINS = ("mixed", "both")
NUMBERS = ("mdp_raw", "pomdp_raw", "mdp", "pomdp", "gap", "bias", "mdp_iqm", "pomdp_iqm")
"""Columns of the table that have an interval."""
SIGNED_GAMES = ("BattleShip", "MineSweeper", "Breakout", "Tetris", "Navigator", "Signpost")
"""Games whose returns lie in [-1, 1]; the others' lie in [0, 1] already, and so should those of
your own games.
"""
_ROUNDING = 1e-4  # of a return


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
    if is_mixture(env_id):
        raise ValueError(
            f"{env_id} is several games, whose returns have no scale in common: evaluate each by "
            "itself (evaluate --game)"
        )
    return (value + 1) / 2 if game_of(env_id) in SIGNED_GAMES else value


def range_note(scores: Iterable[Score], tasks: Iterable[str]) -> str:
    """What to say of those tasks of which a normalised return lies outside of [0, 1], games of
    one's own; empty where there is none.
    """
    wide = set[str]()
    for score in scores:
        value = normalise(score.game, score.value)
        if not -_ROUNDING <= value <= 1 + _ROUNDING:
            wide.add(score.game)
    named = [task for task in tasks if task in wide]
    if not named:
        return ""
    return (
        f"returns of {', '.join(named)} lie outside of [0, 1] and count as they are, so gap and "
        "bias are not of that scale: give a game of yours returns in [0, 1]"
    )


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
    baseline: str  # the memory-free agent, of several algorithms the first; empty if there is none
    baselines: Mapping[str, str | None]  # agent -> the memory-free agent of its algorithm
    confidence: float  # nominal, of the intervals
    draws: int  # of the bootstrap
    # rows leaving out one game, all its difficulties; empty for one game
    without: Mapping[str, tuple[AgentRow, ...]]
    _values: Mapping[str, Mapping[str, Array]] = field(repr=False)

    @property
    def trouble(self) -> str:
        """Why no agent has a Bias; empty where there is a memory-free one."""
        return "" if self.baseline else _without_baseline(list(self.baselines), MEMORY_FREE)

    def check_bias(self) -> None:
        """Raise ValueError if no agent has a Bias."""
        if self.trouble:
            raise ValueError(self.trouble)

    def row(self, agent: str) -> AgentRow:
        """The row of an agent."""
        rows = {row.agent: row for row in self.rows}
        require(agent in rows, "an agent", agent, f"one of {', '.join(rows)}")
        return rows[agent]

    @property
    def coverage(self) -> dict[int, float]:
        """Fewest seeds -> measured coverage of the intervals of Gap, the smallest of the agents
        with so few.
        """
        smallest = dict[int, float]()
        for row in self.rows:
            if not np.isnan(row.coverage):
                smallest[row.seeds] = min(row.coverage, smallest.get(row.seeds, 1.0))
        return dict(sorted(smallest.items()))

    def difference(self, name: str, first: str, second: str) -> Interval:
        """A number of the table, such as ``gap``, of one agent minus another's, its interval from
        the same draws.
        """
        rows = [self.row(first), self.row(second)]
        has_interval = min(row.seeds for row in rows) > 1
        if name == "bias" and self.baselines[first] != self.baselines[second]:
            has_interval = all(row.bias.exists for row in rows)
        values = self._values[first][name] - self._values[second][name]
        return percentile_interval(values[0], values[1:], self.confidence, has_interval)

    def table(self) -> list[dict[str, Any]]:
        """Plain rows, for a CSV file; games left out stand in column ``without``."""
        rows = [_plain_row(row) for row in self.rows]
        for game, rows_without in self.without.items():
            rows += [_plain_row(row, game) for row in rows_without]
        return rows


def _plain_row(row: AgentRow, without: str = "") -> dict[str, Any]:
    """A row for a CSV file: an interval takes three columns."""
    values: dict[str, Any] = {"agent": row.agent, "without": without, "seeds": row.seeds}
    for name in NUMBERS:
        interval = getattr(row, name)
        values[name] = interval.value
        values[f"{name}_low"] = interval.low
        values[f"{name}_high"] = interval.high
    values["coverage"] = row.coverage
    return values


def gap_and_bias(
    runs: Source,
    *,
    metric: str = "eval_final",
    baseline: str = MEMORY_FREE,
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
            Without any ``mlp`` there are gaps and no Bias; another name has to be there.
        draws: bootstrap draws.
        confidence: of the intervals, in (0, 1).
        seed: of the draws.

    Returns:
        The table.

    Raises:
        ValueError: no agent is complete on any task, the baseline is missing, or an argument is out
            of range.
    """
    confidence = coerce("confidence", confidence, float)
    require(0 < confidence < 1, "confidence", confidence, "between 0 and 1")
    draws = whole_from(1, "draws", draws)
    seed = whole_from(0, "seed", seed)
    cells = _cells(read_scores(runs, metric))
    baselines = _baselines(cells, baseline)
    games = list(dict.fromkeys(game for _, game, _ in cells))
    tasks = [game for game in games if _is_complete(game, cells, baselines)]
    if not tasks:
        raise ValueError(
            "no task has finished runs of every agent on both twins, and gap and bias compare them"
        )
    rows, values = _rows(cells, baselines, tasks, draws, confidence, seed, iqm=True)
    return GapBias(
        rows=rows,
        tasks=tuple(tasks),
        dropped=tuple(game for game in games if game not in tasks),
        metric=metric,
        baseline=rows[0].agent if any(baselines.values()) else "",
        baselines=baselines,
        confidence=confidence,
        draws=draws,
        without=_rows_without(cells, baselines, tasks, draws, confidence, seed),
        _values=values,
    )


Cells = dict[tuple[str, str, str], Array]
Baselines = Mapping[str, str | None]


def _cells(scores: Sequence[Score]) -> Cells:
    """The scores by (agent, game, twin), ordered by seed; those of no single twin are left out."""
    by_cell: dict[tuple[str, str, str], list[tuple[int, float]]] = {}
    for score in scores:
        if score.observability in BOTH_TWINS:
            continue
        require(
            score.observability in TWINS, "observability", score.observability, "full or partial"
        )
        if not np.isfinite(score.value):
            raise ValueError(
                f"the score of {score.agent} on {score.game}, seed {score.seed}, is {score.value}"
            )
        cell = (score.agent, score.game, score.observability)
        by_cell.setdefault(cell, []).append((score.seed, score.value))
    cells = Cells()
    for cell, pairs in by_cell.items():
        cells[cell] = np.array([value for _, value in sorted(pairs)])
    return cells


def _baselines(cells: Cells, baseline: str) -> dict[str, str | None]:
    """The memory-free agent of every agent, or None; memory-free agents come first."""
    agents = list(dict.fromkeys(agent for agent, _, _ in cells))
    memory_free = find_baselines(agents, baseline)
    alike = any(named_like(agent, baseline) for agent in agents)
    if not memory_free and (alike or not agents or baseline != MEMORY_FREE):
        raise ValueError(_without_baseline(agents, baseline))
    return {agent: memory_free.get(agent) for agent in [*memory_free.values(), *agents]}


def _without_baseline(agents: Sequence[str], baseline: str) -> str:
    """Say that nobody is the memory-free agent, and what to do."""
    advice = f"train --memory {baseline} on the same games and both twins"
    alike = [agent for agent in agents if named_like(agent, baseline)]
    if alike:
        advice = f"name it, --baseline {alike[0]}, if that is one, or {advice}"
    return (
        f"no scores for the memory-free agent {baseline!r}, only for "
        f"{', '.join(agents) or 'nobody'}; memory bias is against one: {advice}"
    )


def _is_complete(game: str, cells: Cells, agents: Iterable[str]) -> bool:
    """Whether all agents have scores on both twins of a game."""
    return all((agent, game, twin) in cells for agent, twin in product(agents, TWINS))


def _rows_without(
    cells: Cells,
    baselines: Baselines,
    tasks: Sequence[str],
    draws: int,
    confidence: float,
    seed: int,
) -> dict[str, tuple[AgentRow, ...]]:
    """The rows that leave out one game, all its difficulties; none if there is only one game."""
    games = list(dict.fromkeys(game_of(task) for task in tasks))
    without = {}
    if len(games) > 1:
        for game in games:
            rest = [task for task in tasks if game_of(task) != game]
            without[game], _ = _rows(cells, baselines, rest, draws, confidence, seed, iqm=False)
    return without


def _place(task: str) -> tuple[str, int, str]:
    """Where a task stands in the order of games, difficulties and ids."""
    game = game_of(task)
    rest = re.sub(r"-v\d+$", "", task).removeprefix(game)
    return game, DIFFICULTIES.index(rest) if rest in DIFFICULTIES else -1, task


def generator_of(seed: int, agent: str, task: str, twin: str) -> np.random.Generator:
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
    for agent, memory_free in baselines.items():
        mdp, mdp_seeds = _returns(cells, agent, tasks, "full", draws, seed, iqm)
        pomdp, pomdp_seeds = _returns(cells, agent, tasks, "partial", draws, seed, iqm)
        numbers = values.setdefault(agent, {})
        for name in mdp:
            numbers[f"mdp{name}"] = mdp[name]
            numbers[f"pomdp{name}"] = pomdp[name]
        numbers["gap"] = numbers["mdp"] - numbers["pomdp"]
        if memory_free is None:
            numbers["bias"] = np.full_like(numbers["mdp"], np.nan)
        else:
            numbers["bias"] = numbers["mdp"] - values[memory_free]["mdp"]
        fewest = min(*mdp_seeds, *pomdp_seeds)
        fewest_of_bias = min(fewest, *_seeds(cells, memory_free or agent, tasks, "full"))
        ends = dict[str, Interval]()
        for name, draws_of_number in numbers.items():
            has_interval = (fewest_of_bias if name == "bias" else fewest) > 1
            ends[name] = percentile_interval(
                draws_of_number[0], draws_of_number[1:], confidence, has_interval
            )
        coverage = float("nan")
        if fewest > 1:
            coverage = bootstrap.measured_coverage(mdp_seeds, pomdp_seeds, confidence)
        rows.append(AgentRow(agent, fewest, coverage=coverage, **ends))
    return tuple(rows), values


def _returns(
    cells: Cells,
    agent: str,
    tasks: Sequence[str],
    twin: str,
    draws: int,
    seed: int,
    iqm: bool,
) -> tuple[dict[str, Array], tuple[int, ...]]:
    """Returns of an agent on one twin, each [1 + draws]: ``_raw``, normalised (an empty name), and
    ``_iqm``, without draws unless ``iqm``; and its number of seeds of every task.
    """
    raw = list[Array]()
    scaled = list[Array]()
    for task in tasks:
        seeds = cells[agent, task, twin]
        (drawn,) = bootstrap.resampled([seeds], draws, generator_of(seed, agent, task, twin))
        returns = np.vstack([seeds, drawn])
        raw.append(returns)
        scaled.append(normalise(task, returns))
    of_iqm = scaled if iqm else [returns[:1] for returns in scaled]
    means = {
        "_raw": bootstrap.mean_over_tasks(raw),
        "": bootstrap.mean_over_tasks(scaled),
        "_iqm": bootstrap.iqm(of_iqm),
    }
    return means, _seeds(cells, agent, tasks, twin)


def _seeds(cells: Cells, agent: str, tasks: Sequence[str], twin: str) -> tuple[int, ...]:
    """The number of seeds of an agent on one twin of every task."""
    return tuple(len(cells[agent, task, twin]) for task in tasks)
