"""State contamination: what one noisy or shuffled past frame does to later decisions."""

from dataclasses import dataclass

from arcade_torch.tools.measures import CheckpointOptions

# The comment behind an option is its help.


@dataclass
class ContaminationOptions(CheckpointOptions):
    """Options of state contamination."""

    # Standard deviations of the noise; 1 is the range of a pixel.
    sigmas: tuple[float, ...] = (0.1, 0.3, 1.0)
    delays: tuple[int, ...] = (0, 1, 2, 5, 10, 20, 50, 100)
    """Steps from the noisy frame to the decision; 0 is the ceiling."""
    # Of the example: steps from the start, or from the shuffled frames, to the decision.
    horizon: int = 10
    starts: int = 200  # Start points of each checkpoint, at most four an episode.
    shuffle: bool = False  # Permute frames 2 to 10 in place of adding noise.
    clip: bool = False  # Keep noisy pixels in their range.
    # Let the replay choose the previous actions itself, as the published code does.
    feedback: bool = False
    confidence: float = 0.95  # Of the bars.
