"""The paper's published returns: its table of aggregates, with the intervals that its standard
deviations allow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools.files import Table
from arcade_torch.tools.measures.bootstrap import Interval
from arcade_torch.tools.measures.gap_bias.measure import (
    SIGNED_GAMES,
    AgentRow,
    GapBias,
    game_of,
    gap_and_bias,
)

PAPER_RETURNS = Path(__file__).resolve().parents[2] / "data" / "paper_returns.csv"
"""Mean and standard deviation of 9 agents on 30 tasks and both twins, raw, rounded to two
decimals."""

SEEDS = 5
"""Seeds (people, for human) behind every published mean."""


class Spread(NamedTuple):
    """Errors of an aggregate over tasks."""

    sem: float
    half_width: float


@dataclass(frozen=True)
class PaperTable:
    """The published aggregates."""

    table: GapBias
    mdp: Mapping[str, Spread]
    pomdp: Mapping[str, Spread]

    def printed(self) -> Table:
        """The table, three decimals; errors four."""
        rows = list[tuple[str, ...]]()
        for row, rest in zip(self.table.rows, self.table.without["Tetris"], strict=True):
            mdp = self.mdp[row.agent]
            pomdp = self.pomdp[row.agent]
            cells = (
                row.agent,
                f"{row.mdp.value:.3f}",
                f"{row.pomdp.value:.3f}",
                f"{row.gap.value:+.3f}",
                f"{row.bias.value:+.3f}",
                f"{rest.pomdp.value:.3f}",
                f"{rest.gap.value:+.3f}",
                f"{rest.bias.value:+.3f}",
                f"{mdp.sem:.4f}/{pomdp.sem:.4f}",
                f"{mdp.half_width:.4f}/{pomdp.half_width:.4f}",
            )
            rows.append(cells)
        head = (
            "agent",
            "MDP",
            "POMDP",
            "gap",
            "bias",
            "POMDP*",
            "gap*",
            "bias*",
            "SEM",
            "95 % half-width",
        )
        about = (
            f"* without Tetris; errors: MDP/POMDP; {len(self.table.tasks)} tasks, {SEEDS} seeds "
            "(people) each"
        )
        return Table("published returns, normalised", head, rows, about)


def paper_table() -> PaperTable:
    """Aggregates of the published returns.

    Intervals are normal and 95 %, from the published standard deviations, with independent tasks;
    errors of Gap and Bias add in quadrature, as both sides are separate runs.
    """
    table = gap_and_bias(PAPER_RETURNS, draws=1)
    published = read_csv(PAPER_RETURNS)

    spreads = Spreads(published, table.baseline)
    rows = tuple(spreads.widened(row) for row in table.rows)
    without = {}
    for game, rows_without in table.without.items():
        without[game] = tuple(spreads.widened(row, game) for row in rows_without)
    mdp = {row.agent: spreads.of(row.agent, "full") for row in rows}
    pomdp = {row.agent: spreads.of(row.agent, "partial") for row in rows}
    return PaperTable(replace(table, rows=rows, without=without), mdp, pomdp)


@dataclass(frozen=True)
class Spreads:
    """Errors that the published standard deviations give."""

    published: Sequence[Mapping[str, str]]  # rows of `PAPER_RETURNS`
    baseline: str

    def of(self, agent: str, twin: str, without: str = "") -> Spread:
        """Errors of an agent's mean over tasks, one game left out."""
        column = {"full": "mdp_std", "partial": "pomdp_std"}[twin]
        normalised = list[float]()
        for row in self.published:
            game = game_of(row["env"])
            if row["model"] == agent and game != without:
                scale = 0.5 if game in SIGNED_GAMES else 1.0
                normalised.append(float(row[column]) * scale)
        stds = np.array(normalised)
        half_width = 1.96 * np.sqrt((stds**2 / SEEDS).sum()) / stds.size
        return Spread(float(stds.mean() / np.sqrt(SEEDS * stds.size)), float(half_width))

    def widened(self, row: AgentRow, without: str = "") -> AgentRow:
        """A row of the table with its intervals."""
        mdp = self.of(row.agent, "full", without).half_width
        pomdp = self.of(row.agent, "partial", without).half_width
        bias = 0.0
        if row.agent != self.baseline:
            bias = float(np.hypot(mdp, self.of(self.baseline, "full", without).half_width))
        return replace(
            row,
            seeds=SEEDS,
            mdp=_around(row.mdp.value, mdp),
            pomdp=_around(row.pomdp.value, pomdp),
            gap=_around(row.gap.value, float(np.hypot(mdp, pomdp))),
            bias=_around(row.bias.value, bias),
        )


def _around(value: float, half_width: float) -> Interval:
    """An interval with a value in its middle."""
    return Interval(value, value - half_width, value + half_width)
