"""Noise: a symbol at every step, and only the one with a mark counts.

The mark is a number of its own beside the symbol and stands at a random step. Distractors are the
same symbols, so a memory has to look at symbol and mark together to know what to keep. It is
learned in episodes of 4 to 16 steps and asked at 64. Symbols are drawn evenly: the best guess is
right in 1 of 4.
"""

from fractions import Fraction

import torch

from arcade_torch.tools.bench.memory_tests.batch import Batch, MemoryTest, ask_at_the_end, one_hot

__all__ = ["ASK", "MARK", "NOISE", "SYMBOLS"]

SYMBOLS = 4
ASK = SYMBOLS
MARK = SYMBOLS + 1


def draw(generator: torch.Generator, rows: int, steps: int) -> Batch:
    """``steps`` symbols, one of them marked, then the question."""
    symbols = torch.randint(SYMBOLS, (rows, steps), generator=generator)
    place = torch.randint(steps, (rows, 1), generator=generator)
    question = torch.full((rows, 1), ASK)
    inputs = one_hot(torch.cat([symbols, question], dim=1), ASK + 1)
    mark = one_hot(place, steps + 1).transpose(1, 2)  # a column beside the symbols
    return ask_at_the_end(torch.cat([inputs, mark], dim=-1), symbols.gather(1, place))


NOISE = MemoryTest(
    name="noise",
    asks="name the one symbol with a mark among others",
    level="steps",
    inputs=MARK + 1,
    answers=SYMBOLS,
    chance=Fraction(1, SYMBOLS),
    trained=tuple(range(4, 17)),
    tested=(16, 64),
    draw=draw,
)
