"""Measures of memory, one folder each: options in ``__init__.py``, the mathematics in
``measure.py``, the picture and the report's part in ``figure.py``.

What they share stands here once: what is asked of a policy (`policy`), windows of its episodes
(`windows`), the measures of a checkpoint, kept beside it (`checkpoints`), and intervals over seeds
(`bootstrap`).
"""

from dataclasses import dataclass
from typing import Literal

from arcade_torch.tools.figures import Options

# The comment behind an option is its help.


@dataclass
class EpisodeOptions(Options):
    """Options of figures that play episodes of checkpoints."""

    # Another twin than the agents were trained on.
    observability: Literal["full", "partial"] | None = None
    # Another game than the agents were trained on, or one of their several.
    game: str | None = None
    seed: int = 0  # Of the episodes, and of what is drawn in them.


@dataclass
class CheckpointOptions(EpisodeOptions):
    """Options of figures that look at the outputs of checkpoints."""

    target: Literal["auto", "q", "logits", "probs", "value"] = "auto"
    """The outputs that are looked at; Q-values, or a policy's probabilities, by default."""
