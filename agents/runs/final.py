"""The ``eval.json`` of a finished run: what it has to hold, and whether its numbers agree."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

MEAN_TOLERANCE = 1e-5
"""A mean in float32 may differ from that of its returns in float64 by this share of the largest."""
MOST_COUNT = 1e15
"""The largest number of frames, steps or seconds of a run."""
MOST_RETURN = 3.5e38
"""Above the largest finite return, which has single precision."""


def is_final(values: Any, needed: Sequence[str] = ()) -> bool:
    """Whether ``values``, with all ``needed`` keys, is what the ``eval.json`` of a finished run
    holds.
    """
    if not isinstance(values, dict) or not set(needed) <= set(values):
        return False
    if values.get("status", "finished") != "finished":
        return False
    returns = values.get("returns", [])
    lengths = values.get("lengths", [])
    if not isinstance(returns, list) or not isinstance(lengths, list):
        return False
    has_mean = values["mean"] is not None if "mean" in values else bool(returns)
    if not has_mean:
        return False

    counts = [*lengths, *_present(values, "n", "frames", "seconds")]
    scores = [*returns, *_present(values, "mean", "std", "ci", "train_max_ewm")]
    if not all(_is_real(n, MOST_COUNT) for n in counts):
        return False
    # an evaluation whose returns are infinite is one, and would be so again
    if not all(_is_real(n, MOST_RETURN) or n in (math.inf, -math.inf) for n in scores):
        return False

    are_whole = all(type(length) is int for length in lengths)
    are_pairs = 0 < len(returns) == len(lengths) or not {"returns", "lengths"} <= set(values)
    is_negative = any((values.get(name) or 0) < 0 for name in ("frames", "seconds"))
    return are_whole and are_pairs and not is_negative and not wrong_mean(values)


def _present(values: Mapping[str, Any], *names: str) -> list[Any]:
    """What stands under some names, without what is missing or None."""
    return [values[name] for name in names if values.get(name) is not None]


def _is_real(value: Any, most: float) -> bool:
    """Whether a value is a number up to a size, so that it can be squared; NaN is one."""
    return type(value) in (int, float) and not abs(value) > most


def wrong_mean(values: Any) -> str:
    """In what the mean of an ``eval.json`` is not that of its returns; empty if it is, or what
    stands there are no numbers.
    """
    if not isinstance(values, dict) or "mean" not in values or not values.get("returns"):
        return ""
    try:
        mean = float(values["mean"])
        returns = list(map(float, values["returns"]))
        actual = math.fsum(returns) / len(returns)
        size = max(1.0, *map(abs, returns))
    except (TypeError, ValueError, OverflowError):
        return ""
    is_equal = mean == actual  # of infinities
    if math.isfinite(size):
        is_equal = abs(mean - actual) <= MEAN_TOLERANCE * size  # no number is equal to NaN
    if is_equal or (math.isnan(mean) and math.isnan(actual)):
        return ""
    return f"its mean is {mean:g}, but that of its {len(returns)} returns is {actual:g}"
