"""Tests that tell memories apart, a file each: what is asked, its data, its chance level.

`TESTS` holds them by name. The data of a test is a pure function of a seed
(`MemoryTest.batch`); `training` trains one model in one test, `table` keeps the results and says
what is solved, `figure` draws them.
"""

from arcade_torch.tools.bench.memory_tests.batch import Batch, MemoryTest
from arcade_torch.tools.bench.memory_tests.copying import COPY
from arcade_torch.tools.bench.memory_tests.counting import COUNTING
from arcade_torch.tools.bench.memory_tests.delay import DELAY
from arcade_torch.tools.bench.memory_tests.forgetting import FORGETTING
from arcade_torch.tools.bench.memory_tests.noise import NOISE
from arcade_torch.tools.bench.memory_tests.pairs import ASSOCIATION, CAPACITY
from arcade_torch.tools.bench.memory_tests.rewriting import REWRITING
from arcade_torch.tools.bench.memory_tests.tracking import PARITY, S3, S5

__all__ = ["TESTS", "Batch", "MemoryTest"]

TESTS: dict[str, MemoryTest] = {
    test.name: test
    for test in (
        DELAY,
        NOISE,
        CAPACITY,
        ASSOCIATION,
        REWRITING,
        FORGETTING,
        COPY,
        COUNTING,
        PARITY,
        S3,
        S5,
    )
}
"""Name -> test, in the order of the picture."""
