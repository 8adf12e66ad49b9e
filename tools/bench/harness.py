"""What all benchmarks share: measures in turns with every result consumed.

Measures take turns, so that a slow minute of the machine hits all of them alike. The clock is
torch's, which waits for the device.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from torch.utils.benchmark import timer


@dataclass(frozen=True)
class Measure:
    """Something to time."""

    work: Callable[[], object]
    """Does it once and returns the result; waits for JAX (the clock waits for torch's device)."""
    check: Callable[[Any], int] = lambda result: 0
    """Reads all of the result and returns a whole number; eager torch computes all anyway."""
    units: int = 1  # how many one ``work`` makes


@dataclass
class Measured:
    """What one measure did over all repeats: units a second of each, and all units made and
    consumed.
    """

    rates: list[float] = field(default_factory=list)
    # with the check of the results inside the clock
    rates_with_check: list[float] = field(default_factory=list)
    units: int = 0
    checksum: int = 0  # over everything that was made, modulo 2**64

    @property
    def rate(self) -> float:
        """Median units per second."""
        return median(self.rates)

    @property
    def best_ms(self) -> float:
        """Milliseconds a unit in the best repeat."""
        return 1e3 / max(self.rates)


def interleaved(
    measures: Mapping[str, Measure], seconds: float, repeats: int, warm_ups: int = 3
) -> dict[str, Measured]:
    """Time several things in turns, each so many seconds (or one ``work``) a turn, after warm-ups
    outside the clock.
    """
    for measure in measures.values():
        for _ in range(warm_ups):
            measure.check(measure.work())
    measured = {name: Measured() for name in measures}
    for _ in range(repeats):
        for name, measure in measures.items():
            into = measured[name]
            units = 0
            working = 0.0
            checking = 0.0
            while units == 0 or working + checking < seconds:
                start = timer()
                result = measure.work()
                middle = timer()
                into.checksum = (into.checksum + measure.check(result)) % 2**64
                end = timer()
                working += middle - start
                checking += end - middle
                units += measure.units
            into.units += units
            into.rates.append(units / working)
            into.rates_with_check.append(units / (working + checking))
    return measured
