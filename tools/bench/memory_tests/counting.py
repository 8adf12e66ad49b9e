"""Counting: how many of the steps had a mark, none to seven, among distractors.

It is learned in episodes of 8 to 16 steps and asked at 64, with as many marks. The number is drawn
first, evenly from 0 to 7, and the marks are put at random steps; the question looks the same after
all of them: the best guess is right in 1 of 8.
"""

from fractions import Fraction

import torch

from arcade_torch.tools.bench.memory_tests.batch import (
    Batch,
    MemoryTest,
    ask_at_the_end,
    one_hot,
    shuffled,
)

__all__ = ["COUNTING", "MARK"]

MARK = 0
DISTRACTORS = 3
ASK = 1 + DISTRACTORS
COUNTS = 8


def draw(generator: torch.Generator, rows: int, steps: int) -> Batch:
    """``steps`` steps, some of them marks, then the question."""
    count = torch.randint(COUNTS, (rows, 1), generator=generator)
    marked = shuffled(generator, rows, steps) < count
    others = 1 + torch.randint(DISTRACTORS, (rows, steps), generator=generator)
    question = torch.full((rows, 1), ASK)
    tokens = torch.cat([torch.where(marked, MARK, others), question], dim=1)
    return ask_at_the_end(one_hot(tokens, ASK + 1), count)


COUNTING = MemoryTest(
    name="counting",
    asks="say how many marks there were, 0 to 7",
    level="steps",
    inputs=ASK + 1,
    answers=COUNTS,
    chance=Fraction(1, COUNTS),
    trained=tuple(range(8, 17)),
    tested=(16, 64),
    draw=draw,
)
