"""A running mean of weights, over a window that grows with what has been learned."""

import math

from torch import nn


def share_reached(training_return: float | None, return_range: tuple[float, float]) -> float:
    """A return as a share of what a game can pay: 0 at the lowest return (and before any), 1 at the
    highest.
    """
    if training_return is None:
        return 0.0
    low, high = return_range
    return min(1.0, max(0.0, (training_return - low) / (high - low)))


def window_share(training_return: float | None, return_range: tuple[float, float]) -> float:
    """How much of the longest window the mean goes over: 0 at the lowest return, 1 at the highest.

    A game that pays from 0 on has the fourth power of the share that is reached. Where returns
    below 0 are possible the exponent is larger, four times the range over its part above 0: near
    the highest return, the window then depends on the return as in a game without them.
    """
    low, high = return_range
    exponent = 4 * (high - low) / high if low < 0 < high else 4
    return share_reached(training_return, return_range) ** exponent


def check_return_range(game: str, return_range: tuple[float, float]) -> None:
    """Raise ValueError if no share of the range can be told."""
    low, high = return_range
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(
            f"average_share goes by how much of a game's return is reached, but {game} has "
            f"return_range ({low}, {high}): give the game two finite numbers, the lowest and the "
            "highest return, or set it to 0"
        )


def move_mean(mean: nn.Module, network: nn.Module, window: float) -> None:
    """Move a mean of weights towards those of the network that learns.

    Args:
        mean: a network whose weights are the mean.
        network: the same network, one update further.
        window: updates that the mean goes over, beside the newest; 0: no mean at all.
    """
    for old, new in zip(mean.parameters(), network.parameters(), strict=True):
        old.data.lerp_(new.data, 1 / (1 + window))
