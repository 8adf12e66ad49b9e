"""Recall density: how decisions spread over the past of their episodes."""

from dataclasses import dataclass
from typing import Literal

from arcade_torch.tools.measures import CheckpointOptions

# The comment behind an option is its help.


@dataclass
class DensityOptions(CheckpointOptions):
    """Options of recall density."""

    bins: tuple[int, ...] = (3, 16)  # Numbers of bins, a figure each; up to 6 as stacked bars.
    episodes: int = 100  # Greedy trajectories of each checkpoint.
    # The decision: the one that ended the episode, or a random one.
    end: Literal["last", "random"] = "last"
    max_frames: int = 512  # Longest trajectory; a longer episode gives a window with a random end.
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    norm: Literal["l1", "l2sq", "l2"] = "l1"  # Norm of a gradient over a frame.
    confidence: float = 0.95  # Of the bands.
