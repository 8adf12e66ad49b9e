"""Counterfactual recall: which past frames a decision rests on."""

from dataclasses import dataclass
from typing import Literal

from arcade_torch.tools.measures import CheckpointOptions

# The comment behind an option is its help.


@dataclass
class CounterfactualOptions(CheckpointOptions):
    """Options of counterfactual recall."""

    episodes: int = 64  # Greedy episodes of each checkpoint, a decision each.
    donors: int = 4  # Other episodes that each frame is exchanged for.
    block: int = 1  # Consecutive frames exchanged together.
    lags: int = 24  # How far back frames are exchanged.
    # The decision: the one that ended the episode, or a random one.
    end: Literal["last", "random"] = "last"
    max_frames: int = 512  # Longest trajectory; a longer episode gives a window with a random end.
    confidence: float = 0.95  # Of the bands.
