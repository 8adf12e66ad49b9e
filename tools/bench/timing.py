"""Timing that interleaves what it compares, so that a slow minute of the machine hits all of it alike."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median


@dataclass
class Measured:
    """What one measure did over all repeats.

    Attributes:
        rates: units per second of each repeat, the check of the results left out.
        rates_with_check: the same with the check inside the clock.
        units: how many were made and consumed in all timed repeats.
        checksum: sum over everything that was made, modulo 2**64.
    """

    rates: list[float]
    rates_with_check: list[float]
    units: int = 0
    checksum: int = 0

    @property
    def rate(self) -> float:
        """Median units per second."""
        return median(self.rates)

    @property
    def rate_with_check(self) -> float:
        """Median units per second with the check inside the clock."""
        return median(self.rates_with_check)


@dataclass(frozen=True)
class Measure:
    """Something to time.

    Attributes:
        work: does it once and returns the result, finished (a device has been waited for).
        check: reads all of the result and returns a whole number.
        units: how many units one ``work`` makes.
    """

    work: Callable[[], object]
    check: Callable[[object], int]
    units: int


def interleaved(measures: Mapping[str, Measure], seconds: float, repeats: int) -> dict[str, Measured]:
    """Time several measures in turns.

    Args:
        measures: name -> measure; each is warmed up twice first.
        seconds: time for each measure in each repeat.
        repeats: turns.

    Returns:
        name -> what was measured.

    Raises:
        ValueError: ``seconds`` or ``repeats`` is not positive.
    """
    if seconds <= 0 or repeats < 1:
        raise ValueError(f"seconds must be above 0 and repeats at least 1, got {seconds} and {repeats}")
    for measure in measures.values():
        for _ in range(2):
            measure.check(measure.work())
    found = {name: Measured([], []) for name in measures}
    for _ in range(repeats):
        for name, measure in measures.items():
            _repeat(measure, found[name], seconds)
    return found


def _repeat(measure: Measure, into: Measured, seconds: float) -> None:
    units, working, checking = 0, 0.0, 0.0
    while units == 0 or working + checking < seconds:
        start = time.perf_counter()
        result = measure.work()
        middle = time.perf_counter()
        into.checksum = (into.checksum + measure.check(result)) % 2**64
        end = time.perf_counter()
        working, checking, units = working + middle - start, checking + end - middle, units + measure.units
    into.units += units
    into.rates.append(units / working)
    into.rates_with_check.append(units / (working + checking))
