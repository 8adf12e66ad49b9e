"""The paper's published returns: its table of aggregates, with the intervals that its standard deviations allow."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Interval
from arcade_torch.tools.analysis.gap_bias import AgentRow, GapBias, gap_and_bias
from arcade_torch.tools.analysis.normalise import SIGNED_GAMES, split_id
from arcade_torch.tools.files import read_csv

PAPER_RETURNS = Path(__file__).resolve().parent.parent / "data" / "paper_returns.csv"
"""Mean and standard deviation of 9 agents on 30 tasks and both twins, raw, rounded to two decimals."""

SEEDS = 5
"""Seeds (people, for human) behind every published mean."""


@dataclass(frozen=True)
class Spread:
    """Errors of an aggregate over tasks."""

    sem: float
    half_width: float


@dataclass(frozen=True)
class PaperTable:
    """The published aggregates."""

    table: GapBias
    mdp: Mapping[str, Spread]
    pomdp: Mapping[str, Spread]

    def text(self) -> str:
        """The table, three decimals; errors four."""
        head = ("agent", "MDP", "POMDP", "Gap", "Bias", "POMDP*", "Gap*", "Bias*", "SEM", "95% half-width")
        lines = ["{:<10}{:>7}{:>7}{:>8}{:>8}{:>8}{:>8}{:>8}  {:<14}  {}".format(*head)]
        without = {row.agent: row for row in self.table.without["Tetris"]}
        for row in self.table.rows:
            rest, mdp, pomdp = without[row.agent], self.mdp[row.agent], self.pomdp[row.agent]
            lines.append(
                f"{row.agent:<10}{row.mdp.value:>7.3f}{row.pomdp.value:>7.3f}{row.gap.value:>+8.3f}{row.bias.value:>+8.3f}"
                f"{rest.pomdp.value:>8.3f}{rest.gap.value:>+8.3f}{rest.bias.value:>+8.3f}"
                f"  {mdp.sem:.4f}/{pomdp.sem:.4f}   {mdp.half_width:.4f}/{pomdp.half_width:.4f}"
            )
        lines.append(f"* without Tetris; errors: MDP/POMDP; {len(self.table.tasks)} tasks, {SEEDS} seeds (people) each")
        return "\n".join(lines)


def paper_table() -> PaperTable:
    """Aggregates of the published returns.

    Intervals are normal and 95 %, from the published standard deviations, with independent tasks; errors of Gap and
    Bias add in quadrature, as both sides are separate runs.
    """
    table = gap_and_bias(PAPER_RETURNS, draws=1)
    deviations = _deviations()
    base = table.baseline
    rows = tuple(_with_intervals(row, deviations, base, "") for row in table.rows)
    without = {
        game: tuple(_with_intervals(row, deviations, base, game) for row in part)
        for game, part in table.without.items()
    }
    errors = {
        twin: {row.agent: _spread(deviations[row.agent, twin], "") for row in table.rows}
        for twin in ("full", "partial")
    }
    return PaperTable(replace(table, rows=rows, without=without), errors["full"], errors["partial"])


def _deviations() -> dict[tuple[str, str], list[tuple[str, float]]]:
    """(agent, twin) -> normalised standard deviations over seeds, with the game of each."""
    found: dict[tuple[str, str], list[tuple[str, float]]] = {}
    for row in read_csv(PAPER_RETURNS):
        game = split_id(row["env"]).game
        scale = 0.5 if game in SIGNED_GAMES else 1.0
        for twin, column in (("full", "mdp_std"), ("partial", "pomdp_std")):
            found.setdefault((row["model"], twin), []).append((game, scale * float(row[column])))
    return found


def _spread(deviations: list[tuple[str, float]], without: str) -> Spread:
    kept = np.array([value for game, value in deviations if game != without])
    half = 1.96 * np.sqrt((kept**2 / SEEDS).sum()) / kept.size
    return Spread(float(kept.mean() / np.sqrt(SEEDS * kept.size)), float(half))


def _with_intervals(
    row: AgentRow, deviations: Mapping[tuple[str, str], list[tuple[str, float]]], base: str, without: str
) -> AgentRow:
    full = _spread(deviations[row.agent, "full"], without).half_width
    partial = _spread(deviations[row.agent, "partial"], without).half_width
    other = _spread(deviations[base, "full"], without).half_width
    bias = 0.0 if row.agent == base else float(np.hypot(full, other))
    return replace(
        row,
        seeds=SEEDS,
        mdp=_around(row.mdp.value, full),
        pomdp=_around(row.pomdp.value, partial),
        gap=_around(row.gap.value, float(np.hypot(full, partial))),
        bias=_around(row.bias.value, bias),
    )


def _around(value: float, half: float) -> Interval:
    return Interval(value, value - half, value + half)
