"""The paper's published returns: its table of aggregates, with the intervals that its standard
deviations allow.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Interval
from arcade_torch.tools.analysis.gap_bias import (
    SIGNED_GAMES,
    TWINS,
    AgentRow,
    GapBias,
    game_of,
    gap_and_bias,
)
from arcade_torch.tools.files import Table, read_csv

PAPER_RETURNS = Path(__file__).resolve().parent.parent / "data" / "paper_returns.csv"
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
        rows = []
        for row, rest in zip(self.table.rows, self.table.without["Tetris"], strict=True):
            shown = row.mdp, row.pomdp, row.gap, row.bias, rest.pomdp, rest.gap, rest.bias
            errors = zip(self.mdp[row.agent], self.pomdp[row.agent], strict=True)
            numbers = (f"{x.value:{sign}.3f}" for x, sign in zip(shown, "--++-++", strict=True))
            rows.append((row.agent, *numbers, *(f"{mdp:.4f}/{pomdp:.4f}" for mdp, pomdp in errors)))
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

    def spread(agent: str, twin: str, without: str = "") -> Spread:
        column = {"full": "mdp_std", "partial": "pomdp_std"}[twin]
        here = [
            (game_of(row["env"]), float(row[column])) for row in published if row["model"] == agent
        ]
        stds = np.array(
            [std * (0.5 if game in SIGNED_GAMES else 1.0) for game, std in here if game != without]
        )
        half = 1.96 * np.sqrt((stds**2 / SEEDS).sum()) / stds.size
        return Spread(float(stds.mean() / np.sqrt(SEEDS * stds.size)), float(half))

    def widened(row: AgentRow, without: str = "") -> AgentRow:
        mdp, pomdp = (spread(row.agent, twin, without).half_width for twin in TWINS)
        bias = (
            0.0
            if row.agent == table.baseline
            else np.hypot(mdp, spread(table.baseline, "full", without).half_width)
        )
        halves = {"mdp": mdp, "pomdp": pomdp, "gap": np.hypot(mdp, pomdp), "bias": bias}
        values = {name: (getattr(row, name).value, float(half)) for name, half in halves.items()}
        intervals: Any = {
            name: Interval(x, x - half, x + half) for name, (x, half) in values.items()
        }
        return replace(row, seeds=SEEDS, **intervals)

    rows = tuple(map(widened, table.rows))
    without = {
        game: tuple(widened(row, game) for row in part) for game, part in table.without.items()
    }
    mdp, pomdp = ({row.agent: spread(row.agent, twin) for row in rows} for twin in TWINS)
    return PaperTable(replace(table, rows=rows, without=without), mdp, pomdp)
