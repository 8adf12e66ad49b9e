"""Copy in order: some symbols, then as many steps that say "go", each of which gives the next one.

All "go" steps look the same, so a memory has to know how far it is. It is learned with 1 to 8
symbols and asked with up to 16. Symbols are drawn evenly: the best guess is right in 1 of 4.
"""

from fractions import Fraction

import torch

from arcade_torch.tools.bench.memory_tests.batch import Batch, MemoryTest, ask_at_the_end, one_hot

__all__ = ["COPY", "GO", "SYMBOLS"]

SYMBOLS = 4
GO = SYMBOLS


def draw(generator: torch.Generator, rows: int, count: int) -> Batch:
    """``count`` symbols, then ``count`` steps that say "go"."""
    symbols = torch.randint(SYMBOLS, (rows, count), generator=generator)
    go = torch.full((rows, count), GO)
    return ask_at_the_end(one_hot(torch.cat([symbols, go], dim=1), GO + 1), symbols)


COPY = MemoryTest(
    name="copy",
    asks="give symbols back in the order in which they came",
    level="symbols",
    inputs=GO + 1,
    answers=SYMBOLS,
    chance=Fraction(1, SYMBOLS),
    trained=tuple(range(1, 9)),
    tested=(4, 8, 16),
    draw=draw,
)
