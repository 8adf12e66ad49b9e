"""Mass over the normalised time of trajectories of different length."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def binned(shares: Array, bins: int) -> Array:
    """Mass in equal parts of a trajectory.

    Step t of N owns the interval [t/N, (t+1)/N) and bin b of B owns [b/B, (b+1)/B); the mass of a step is split by the
    overlap of the intervals. Every trajectory therefore keeps its whole mass, whatever its length.

    Args:
        shares: float64 [N], mass of every step, oldest first.
        bins: B.

    Returns:
        float64 [B], with the sum of ``shares``.

    Raises:
        ValueError: there is no step or no bin.

    Example:
        >>> binned(np.array([0.0, 0.0, 0.0, 1.0]), 3).round(3).tolist()
        [0.0, 0.0, 1.0]
        >>> binned(np.array([1.0, 0.0]), 3).round(3).tolist()
        [0.667, 0.333, 0.0]
    """
    if bins < 1 or shares.size < 1:
        raise ValueError(f"need at least one bin and one step, got {bins} and {shares.size}")
    steps = np.arange(shares.size + 1) / shares.size
    cumulated = np.concatenate([[0.0], np.cumsum(shares)])
    return np.diff(np.interp(np.arange(bins + 1) / bins, steps, cumulated))


def point_sampled(shares: Array, taus: Array) -> Array:
    """The paper's curve: the share of step floor(tau n), n the index of the last step.

    It does not integrate to one over trajectories of different length; `binned` does.
    """
    return shares[np.floor(taus * (shares.size - 1) + 1e-9).astype(np.int64)]


def mean_mass(trajectories: Sequence[Array], bins: int) -> Array:
    """Mean over trajectories of their mass in bins, float64 [B]."""
    return np.asarray(np.mean([binned(shares, bins) for shares in trajectories], axis=0))


def mean_points(trajectories: Sequence[Array], taus: Array) -> Array:
    """Mean over trajectories of the paper's curve, float64 [P]."""
    return np.asarray(np.mean([point_sampled(shares, taus) for shares in trajectories], axis=0))


def uniform_memory(bins: int) -> Array:
    """Reference line: every frame counts the same."""
    return np.full(bins, 1 / bins)


def no_memory(lengths: Sequence[int], bins: int) -> Array:
    """Reference line: only the last frame of each trajectory counts.

    A trajectory with fewer steps than bins spreads its last frame over several of them, as it does its other frames.
    """
    return mean_mass([np.eye(1, length, length - 1)[0] for length in lengths], bins)
