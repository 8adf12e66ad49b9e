"""How often to do what costs more the larger a study is."""

import time
from collections.abc import Callable

SHARE = 0.02
"""Share of the time that such work may take."""


class Pace:
    """Rests after each piece of work, fifty times as long as it took, and ``least_s`` at least.

    Args:
        least_s: shortest rest, seconds.
        clock: gives the time in seconds.
    """

    def __init__(self, least_s: float = 0.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._least_s = least_s
        self._clock = clock
        self._next_s = clock()

    @property
    def rest_s(self) -> float:
        """Seconds until the next piece of work is due; 0 if it is."""
        return max(0.0, self._next_s - self._clock())

    def work(self, task: Callable[[], object]) -> None:
        """Do a piece of work, and rest."""
        start_s = self._clock()
        task()
        end_s = self._clock()
        self._next_s = end_s + max(self._least_s, (end_s - start_s) / SHARE)
