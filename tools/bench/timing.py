"""Timing that interleaves what it compares, so that a slow minute of the machine hits all of it alike."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use so many threads inside, and as many as before afterwards."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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


def no_check(_: object) -> int:
    """The check of eager torch on a CPU, which computes all that it is asked for: there is nothing to consume."""
    return 0


def interleaved(
    measures: Mapping[str, Measure], seconds: float, repeats: int, warm_ups: int = 2
) -> dict[str, Measured]:
    """Time several measures in turns.

    Args:
        measures: name -> measure.
        seconds: time for each measure in each repeat.
        repeats: turns.
        warm_ups: how often each is done before, untimed.

    Returns:
        name -> what was measured.

    Raises:
        ValueError: ``seconds`` or ``repeats`` is not positive.
    """
    if seconds <= 0 or repeats < 1:
        raise ValueError(f"seconds must be above 0 and repeats at least 1, got {seconds} and {repeats}")
    for measure in measures.values():
        for _ in range(warm_ups):
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
