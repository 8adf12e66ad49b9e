"""The paper's published returns: its table of aggregates, with the intervals that its standard deviations allow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Interval
from arcade_torch.tools.analysis.gap_bias import AgentRow, GapBias, gap_and_bias
from arcade_torch.tools.analysis.normalise import SIGNED_GAMES, game_of
from arcade_torch.tools.files import read_csv

PAPER_RETURNS = Path(__file__).resolve().parent.parent / "data" / "paper_returns.csv"
"""Mean and standard deviation of 9 agents on 30 tasks and both twins, raw, rounded to two decimals."""

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
    table, deviations = gap_and_bias(PAPER_RETURNS, draws=1), _deviations()

    def errors(twin: str, without: str = "") -> dict[str, Spread]:
        return {row.agent: _spread(deviations[row.agent, twin], without) for row in table.rows}

    def widened(rows: Sequence[AgentRow], without: str = "") -> tuple[AgentRow, ...]:
        full, partial = errors("full", without), errors("partial", without)
        base = full[table.baseline].half_width
        found = []
        for row in rows:
            mdp, pomdp = full[row.agent].half_width, partial[row.agent].half_width
            bias = 0.0 if row.agent == table.baseline else float(np.hypot(mdp, base))
            halves = {"mdp": mdp, "pomdp": pomdp, "gap": float(np.hypot(mdp, pomdp)), "bias": bias}
            values = {name: (getattr(row, name).value, half) for name, half in halves.items()}
            intervals: Any = {name: Interval(x, x - half, x + half) for name, (x, half) in values.items()}
            found.append(replace(row, seeds=SEEDS, **intervals))
        return tuple(found)

    without = {game: widened(part, game) for game, part in table.without.items()}
    return PaperTable(replace(table, rows=widened(table.rows), without=without), errors("full"), errors("partial"))


def _deviations() -> dict[tuple[str, str], list[tuple[str, float]]]:
    """(agent, twin) -> normalised standard deviations over seeds, with the game of each."""
    found: dict[tuple[str, str], list[tuple[str, float]]] = {}
    for row in read_csv(PAPER_RETURNS):
        game = game_of(row["env"])
        scale = 0.5 if game in SIGNED_GAMES else 1.0
        for twin, column in (("full", "mdp_std"), ("partial", "pomdp_std")):
            found.setdefault((row["model"], twin), []).append((game, scale * float(row[column])))
    return found


def _spread(deviations: list[tuple[str, float]], without: str) -> Spread:
    kept = np.array([value for game, value in deviations if game != without])
    half = 1.96 * np.sqrt((kept**2 / SEEDS).sum()) / kept.size
    return Spread(float(kept.mean() / np.sqrt(SEEDS * kept.size)), float(half))
