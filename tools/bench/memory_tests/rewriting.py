"""Rewriting: four keys get a new value again and again, and the latest one counts.

Every key is written equally often, in a random order, a key and a value a step. It is learned with
1 to 4 values a key and asked with up to 16. The latest value is drawn evenly, and the question
shows the key alone: the best guess is right in 1 of 4. A memory that only adds up knows how often a
key had each value, and not which came last.
"""

from fractions import Fraction

import torch
from torch import Tensor

from arcade_torch.tools.bench.memory_tests.batch import (
    Batch,
    MemoryTest,
    ask_at_the_end,
    one_hot,
    shuffled,
)

__all__ = ["KEYS", "REWRITING", "VALUES"]

KEYS = 4
VALUES = 4


def draw(generator: torch.Generator, rows: int, times: int) -> Batch:
    """``times`` values for each key, then every key with the mark of a question."""
    keys = shuffled(generator, rows, KEYS * times) % KEYS
    values = torch.randint(VALUES, (rows, KEYS * times), generator=generator)
    asked = shuffled(generator, rows, KEYS)
    answers = _latest(keys, values).gather(1, asked)
    question = torch.full((rows, KEYS), VALUES)
    shown_keys = one_hot(torch.cat([keys, asked], dim=1), KEYS)
    shown_values = one_hot(torch.cat([values, question], dim=1), VALUES + 1)
    return ask_at_the_end(torch.cat([shown_keys, shown_values], dim=-1), answers)


def _latest(keys: Tensor, values: Tensor) -> Tensor:
    """The last value of each key, int64 [B, KEYS], of writes in order of time."""
    steps = torch.arange(keys.shape[1])
    written = one_hot(keys, KEYS).bool()
    last = torch.where(written, steps.unsqueeze(-1), -1).amax(dim=1)
    return values.gather(1, last)


REWRITING = MemoryTest(
    name="rewriting",
    asks="name the latest of several values of a key",
    level="values a key",
    inputs=KEYS + VALUES + 1,
    answers=VALUES,
    chance=Fraction(1, VALUES),
    trained=(1, 2, 3, 4),
    tested=(1, 4, 16),
    draw=draw,
)
