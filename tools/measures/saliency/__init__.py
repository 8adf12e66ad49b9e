"""Pixel saliency: which pixels of the past a decision depends on."""

from dataclasses import dataclass
from typing import Literal

from arcade_torch.tools.measures import CheckpointOptions

# The comment behind an option is its help.


@dataclass
class SaliencyOptions(CheckpointOptions):
    """Options of the saliency maps."""

    max_steps: int = 30  # Longest episode; the paper's figures have 30.
    show: int = 8  # How many of the last frames are drawn.
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    norm: Literal["l2sq", "l2", "l1"] = "l2sq"  # Norm over colour channels.
