"""Stratified bootstrap of means over tasks, and how often its intervals really hold the truth."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DRAWS = 2000  # of an interval over seeds


class Interval(NamedTuple):
    """A number and its interval; the ends are NaN where one seed alone gives no interval."""

    value: float
    low: float
    high: float

    @property
    def exists(self) -> bool:
        """Whether there is an interval: whether its ends are numbers."""
        return not math.isnan(self.low)

    @property
    def excludes_zero(self) -> bool:
        """Whether there is an interval and zero lies outside it."""
        return bool(self.low > 0 or self.high < 0)

    @property
    def is_zero(self) -> bool:
        """Whether there is no difference in any seed: the number and both ends are 0."""
        return self.value == self.low == self.high == 0

    def decimals(self, fewest: int = 2) -> int:
        """Decimals at which an interval that excludes zero is seen to, at least ``fewest``.

        Example:
            >>> Interval(0.002, 0.0004, 0.004).decimals()
            4
        """
        near = min(abs(self.low), abs(self.high))
        decimals = fewest
        while self.excludes_zero and round(near, decimals) == 0 and decimals < 12:
            decimals += 1
        return decimals

    def text(self) -> str:
        """The number and its interval for a table; a dash where there is no number.

        Example:
            >>> Interval(0.5, 0.25, 0.75).text()
            '0.50 [0.25, 0.75]'
        """
        if math.isnan(self.value):
            return "-"
        if not self.exists:
            return f"{self.value:.2f}"
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


def resampled(cells: Sequence[Array], draws: int, rng: np.random.Generator) -> list[Array]:
    """The seeds of each task, float64 [n_seeds], resampled with replacement to [draws, n_seeds]."""
    return [cell[rng.integers(len(cell), size=(draws, len(cell)))] for cell in cells]


def mean_over_tasks(cells: Sequence[Array]) -> Array:
    """Mean over tasks of the means over seeds: [..., n_seeds] a task to [...].

    The mean of seeds that are all alike is what they are, to the last bit: three times .7 add up to
    less than 2.1, and an agent with two such seeds would be ahead of one with three.
    """
    means = []
    for cell in cells:
        mean = cell.mean(axis=-1)
        first = cell[..., 0]
        means.append(np.where((cell == first[..., None]).all(axis=-1), first, mean))
    return np.asarray(sum(means) / len(means))


def iqm(cells: Sequence[Array]) -> Array:
    """Interquartile mean: the mean of the middle half of all runs of all tasks; [..., n_seeds] a
    task to [...].

    Source: Agarwal et al. (2021), arXiv 2108.13264.
    """
    runs = np.sort(np.concatenate(cells, axis=-1), axis=-1)
    cut = int(0.25 * runs.shape[-1])
    return np.asarray(runs[..., cut : runs.shape[-1] - cut].mean(axis=-1))


def percentile_interval(
    value: Any, draws: Array, confidence: float, has_interval: bool = True
) -> Interval:
    """Percentile interval of an estimate from its bootstrap draws; ends are NaN without draws, of
    what is not finite, or if not ``has_interval``.
    """
    if not has_interval or not len(draws) or not math.isfinite(value):
        return Interval(float(value), float("nan"), float("nan"))
    low, high = np.quantile(draws, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(value), float(low), float(high))


class Pooled(NamedTuple):
    """Values of every seed [n_seeds, ...], their mean and the ends of its percentile interval, each
    [...].
    """

    seeds: Array
    mean: Array
    low: Array
    high: Array


def pooled(values: Sequence[Any], confidence: float = 0.95) -> Pooled:
    """Pool the arrays of some seeds, cell by cell.

    NaN or infinite is a seed without a value. The ends are NaN where fewer than two seeds have one,
    the mean where none has.
    """

    def cell(seeds: Array) -> Array:
        # the same interval in whatever order the seeds come
        finite = np.sort(seeds[np.isfinite(seeds)])
        if finite.size < 2:
            return np.array([finite[0] if finite.size else np.nan, np.nan, np.nan])
        drawn = mean_over_tasks(resampled([finite], DRAWS, np.random.default_rng(0)))
        return np.array(percentile_interval(mean_over_tasks([finite]), drawn, confidence))

    all_seeds = np.array(values, dtype=np.float64)
    mean, low, high = np.apply_along_axis(cell, 0, all_seeds)
    return Pooled(all_seeds, mean, low, high)


def pooled_episodes(seeds: Sequence[Any], confidence: float = 0.95) -> Pooled:
    """Pool the episodes of some seeds, each [n_episodes, L], column by column: the mean over seeds
    of their means over episodes, both resampled.

    NaN or infinite is an episode without a value. Of a single seed the interval is over episodes
    alone; the ends are NaN where fewer than two of them have a value, the mean where none has.
    """
    arrays = [np.asarray(episodes, dtype=np.float64) for episodes in seeds]
    columns = arrays[0].shape[1]
    means = np.full((len(arrays), columns), np.nan)
    ends = np.full((3, columns), np.nan)
    for column in range(columns):
        rng = np.random.default_rng(0)
        finite = [episodes[np.isfinite(episodes[:, column]), column] for episodes in arrays]
        for place, values in enumerate(finite):
            means[place, column] = values.mean() if values.size else np.nan
        cells = [values for values in finite if values.size]
        if not cells:
            continue
        estimate = float(np.mean([values.mean() for values in cells]))
        of_seeds = np.array([drawn.mean(axis=1) for drawn in resampled(cells, DRAWS, rng)])
        chosen = rng.integers(len(cells), size=(DRAWS, len(cells)))
        drawn = rng.integers(DRAWS, size=chosen.shape)
        several = sum(values.size for values in cells) > 1
        values = of_seeds[chosen, drawn].mean(axis=1)
        ends[:, column] = percentile_interval(estimate, values, confidence, several)
    mean, low, high = ends
    return Pooled(means, mean, low, high)


@lru_cache(maxsize=64)
def measured_coverage(
    mdp_seeds: tuple[int, ...],
    pomdp_seeds: tuple[int, ...],
    confidence: float = 0.95,
    simulations: int = 2000,
    draws: int = 500,
) -> float:
    """Share of simulated studies whose interval for Gap holds the true Gap, with a standard error
    of about 0.01.

    Scores are standard Gaussian in the simulation, the same spread in every task, of which
    ``mdp_seeds`` and ``pomdp_seeds`` have the numbers of seeds. With few seeds the share is well
    below the nominal confidence; a report says so beside its intervals. Large studies are simulated
    less often, so that this takes about a second.
    """
    rng = np.random.default_rng(0)
    cost = draws * sum(mdp_seeds + pomdp_seeds)
    simulations = max(200, min(simulations, int(4e7 / cost)))
    gaps = np.zeros((simulations, draws))  # the true one is 0
    for sign, counts in ((1.0, mdp_seeds), (-1.0, pomdp_seeds)):
        for count in np.minimum(counts, 200):  # more hardly change the share, but take gigabytes
            scores = rng.standard_normal((simulations, count))
            picks = rng.integers(count, size=(simulations, draws * count))
            means = (
                np.take_along_axis(scores, picks, axis=1)
                .reshape(simulations, draws, count)
                .mean(axis=2)
            )
            gaps += sign * means / len(counts)
    ends = np.quantile(gaps, [(1 - confidence) / 2, (1 + confidence) / 2], axis=1)
    return float(np.mean((ends[0] <= 0) & (ends[1] >= 0)))
