"""Observability Gap and Memory Bias: what partial observability costs an agent, and what memory
costs where it is not needed.
"""

from dataclasses import dataclass

from arcade_torch.tools.figures import CurveOptions, PaperOptions

# The comment behind an option is its help.


@dataclass
class SweepOptions(CurveOptions):
    """Options of figures of Gap and Bias."""

    baseline: str = "mlp"  # The memory-free agent.
    draws: int = 10_000  # Bootstrap draws.


@dataclass
class ScoreOptions(SweepOptions, PaperOptions):
    """Options of figures that are made from scores; ``runs`` may be CSV files too."""
