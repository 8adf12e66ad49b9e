"""Beliefs: which hidden facts can be read off a recurrent state."""

from dataclasses import dataclass

from arcade_torch.tools.measures import EpisodeOptions

# The comment behind an option is its help.


@dataclass
class BeliefsOptions(EpisodeOptions):
    """Options of probes of the recurrent state."""

    # Greedy episodes of each checkpoint; half fit the probe, a quarter test it.
    episodes: int = 128
    max_steps: int = 128  # Steps that are looked at, from the beginning of each episode.
    confidence: float = 0.95  # Of the intervals.
