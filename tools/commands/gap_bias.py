"""``arcade-torch analyze gap-bias``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from arcade_torch.tools.files import write_csv
from arcade_torch.tools.tables import show_table


@dataclass
class GapBiasCommand:
    """Observability gap (MDP - POMDP) and memory bias (MDP - memory-free MDP) of every agent, with bootstrap intervals.

    Example: arcade-torch analyze gap-bias runs/demo --metric train_max_ewm
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Study folders, run folders, or CSV files with columns agent, game, observability, seed, score."""
    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run: final greedy evaluation, or the paper's best smoothed training return."""
    baseline: str = "mlp"
    """The memory-free agent."""
    draws: int = 10_000
    """Bootstrap draws."""
    confidence: float = 0.95
    """Of the intervals."""
    out: Path | None = None
    """CSV file for the table; overwritten."""

    def run(self) -> int:
        """Compute, print, save."""
        from arcade_torch.tools.analysis.gap_bias import gap_and_bias

        if not self.runs:
            raise ValueError("name at least one study folder, run folder or CSV file")
        table = gap_and_bias(
            list(self.runs), metric=self.metric, baseline=self.baseline, draws=self.draws, confidence=self.confidence
        )
        rows = [
            (
                row.agent,
                row.seeds,
                f"{row.mdp_raw.value:+.3f}",
                f"{row.pomdp_raw.value:+.3f}",
                row.mdp,
                row.pomdp,
                row.gap,
                row.bias,
            )
            for row in table.rows
        ]
        show_table(
            f"gap and bias over {len(table.tasks)} task{'s' * (len(table.tasks) > 1)} ({table.metric})",
            ("agent", "seeds", "MDP raw", "POMDP raw", "MDP", "POMDP", "gap", "bias"),
            rows,
            caption(table.confidence, {row.seeds: row.coverage for row in table.rows}),
        )
        if table.dropped:
            print(f"left out, because some agent lacks them: {', '.join(table.dropped)}")
        if self.out is not None:
            plain = table.table()
            print(f"table: {write_csv(self.out, plain, list(plain[0]))}")
        return 0


def caption(confidence: float, coverage: dict[int, float]) -> str:
    """What to know about the intervals.

    Args:
        confidence: nominal.
        coverage: number of seeds -> measured coverage (NaN where there are no intervals).
    """
    measured = [
        f"{100 * share:.0f} % with {seeds} seeds" for seeds, share in sorted(coverage.items()) if share == share
    ]
    if not measured:
        return "no intervals: a single seed"
    return (
        f"[{100 * confidence:g} % bootstrap interval over seeds]; measured coverage of the gap's: {', '.join(measured)}"
    )


COMMAND = GapBiasCommand
