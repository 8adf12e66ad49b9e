"""Selective forgetting: symbols at places, of which some are to be forgotten and the others kept.

A fifth of the places is named again by a token that says "forget it"; asked for one of those, the
answer is a fifth class, "nothing". Of five places with a symbol each, one is forgotten: "nothing"
is right in 1 of 5 questions, and so is each of the four symbols, which are drawn evenly. The
question shows the place alone: the best guess is right in 1 of 5.
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

__all__ = ["FORGETTING", "NOTHING", "PLACES", "SYMBOLS"]

PLACES = 10
SYMBOLS = 4
NOTHING = SYMBOLS
FORGET = PLACES * SYMBOLS
"""First of the tokens that say which place to forget."""
ASK = FORGET + PLACES
"""First of the tokens that ask for a place."""


def draw(generator: torch.Generator, rows: int, count: int) -> Batch:
    """``count`` places with a symbol, a fifth of them forgotten, all of them asked for."""
    places = shuffled(generator, rows, PLACES)[:, :count]
    symbols = torch.randint(SYMBOLS, (rows, count), generator=generator)
    answers = symbols.clone()
    dropped = shuffled(generator, rows, count)[:, : count // 5]
    answers.scatter_(1, dropped, NOTHING)
    order = shuffled(generator, rows, count)
    tokens = _tokens(places, symbols, places.gather(1, dropped), places.gather(1, order))
    return ask_at_the_end(one_hot(tokens, ASK + PLACES), answers.gather(1, order))


def _tokens(places: Tensor, symbols: Tensor, dropped: Tensor, asked: Tensor) -> Tensor:
    """What is shown, in order of time."""
    writes = places * SYMBOLS + symbols
    return torch.cat([writes, FORGET + dropped, ASK + asked], dim=1)


FORGETTING = MemoryTest(
    name="forgetting",
    asks="forget the places that are named, and keep the others",
    level="symbols",
    inputs=ASK + PLACES,
    answers=SYMBOLS + 1,
    chance=Fraction(1, SYMBOLS + 1),
    trained=(5, 10),
    tested=(5, 10),
    draw=draw,
)
