"""Schedules as functions of the number of frames seen."""


def linear(start: float, end: float, frames: float, duration: float) -> float:
    """Straight line from ``start`` to ``end``, constant afterwards.

    Args:
        start: value at frame 0.
        end: value from ``duration`` on.
        frames: frames seen so far (one environment, one action, one frame); >= 0.
        duration: frames the line takes; 0 gives ``end`` at once.

    Returns:
        The value at ``frames``.

    Example:
        >>> [linear(1.0, 0.0, frames, 100) for frames in (0, 25, 100, 1000)]
        [1.0, 0.75, 0.0, 0.0]
    """
    if frames >= duration:
        return end
    return start + (end - start) * (frames / duration)
