"""Delay: one of four symbols, then distractors, then the question.

The distractors are four other tokens. It is learned at delays of 1 to 16 steps and asked at up to
16 times as many. The symbol is drawn evenly and the question looks the same after all of them: the
best guess is right in 1 of 4.
"""

from fractions import Fraction

import torch

from arcade_torch.tools.bench.memory_tests.batch import Batch, MemoryTest, ask_at_the_end, one_hot

__all__ = ["ASK", "DELAY", "SYMBOLS"]

SYMBOLS = 4
DISTRACTORS = 4
ASK = SYMBOLS + DISTRACTORS


def draw(generator: torch.Generator, rows: int, delay: int) -> Batch:
    """A symbol, ``delay`` distractors, the question."""
    symbol = torch.randint(SYMBOLS, (rows, 1), generator=generator)
    between = SYMBOLS + torch.randint(DISTRACTORS, (rows, delay), generator=generator)
    question = torch.full((rows, 1), ASK)
    tokens = torch.cat([symbol, between, question], dim=1)
    return ask_at_the_end(one_hot(tokens, ASK + 1), symbol)


DELAY = MemoryTest(
    name="delay",
    asks="name the symbol that was shown at the first step",
    level="steps between",
    inputs=ASK + 1,
    answers=SYMBOLS,
    chance=Fraction(1, SYMBOLS),
    trained=tuple(range(1, 17)),
    tested=(16, 64, 256),
    draw=draw,
)
