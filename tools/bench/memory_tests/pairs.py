"""Capacity and associative recall: pairs of a place and a symbol, then a question for each place.

Both show pairs in a random order and ask for all of them in another. In *capacity* a pair is one
token of its own ("place 3 holds symbol 2"), so that nothing has to be bound and what is counted is
the symbols held. In *associative recall* the same step shows a key and a value as two separate
ones, and a memory has to bind them: a sum of keys and values does not say which belong together.

Symbols are drawn evenly, and the question shows the place alone: the best guess is right in 1 of 4.
"""

from fractions import Fraction
from typing import NamedTuple

import torch
from torch import Tensor

from arcade_torch.tools.bench.memory_tests.batch import (
    Batch,
    MemoryTest,
    ask_at_the_end,
    one_hot,
    shuffled,
)

__all__ = ["ASSOCIATION", "CAPACITY", "PLACES", "SYMBOLS"]

PLACES = 16
SYMBOLS = 4


class Pairs(NamedTuple):
    """Pairs, and the order in which they are asked for; int64 [B, pairs]."""

    places: Tensor
    symbols: Tensor
    asked: Tensor
    answers: Tensor


def draw_pairs(generator: torch.Generator, rows: int, count: int) -> Pairs:
    """``count`` different places, a symbol at each of them, and all of them asked for."""
    places = shuffled(generator, rows, PLACES)[:, :count]
    symbols = torch.randint(SYMBOLS, (rows, count), generator=generator)
    order = shuffled(generator, rows, count)
    return Pairs(places, symbols, places.gather(1, order), symbols.gather(1, order))


def draw_tokens(generator: torch.Generator, rows: int, count: int) -> Batch:
    """A token for each pair, then a token for each question."""
    pairs = draw_pairs(generator, rows, count)
    writes = pairs.places * SYMBOLS + pairs.symbols
    questions = PLACES * SYMBOLS + pairs.asked
    tokens = torch.cat([writes, questions], dim=1)
    return ask_at_the_end(one_hot(tokens, PLACES * SYMBOLS + PLACES), pairs.answers)


def draw_keys_and_values(generator: torch.Generator, rows: int, count: int) -> Batch:
    """A key and a value a step, then a key and the mark of a question a step."""
    pairs = draw_pairs(generator, rows, count)
    keys = torch.cat([pairs.places, pairs.asked], dim=1)
    question = torch.full((rows, count), SYMBOLS)
    values = torch.cat([pairs.symbols, question], dim=1)
    inputs = torch.cat([one_hot(keys, PLACES), one_hot(values, SYMBOLS + 1)], dim=-1)
    return ask_at_the_end(inputs, pairs.answers)


CAPACITY = MemoryTest(
    name="capacity",
    asks="hold many symbols at once, each at a place that its token names",
    level="symbols",
    inputs=PLACES * SYMBOLS + PLACES,
    answers=SYMBOLS,
    chance=Fraction(1, SYMBOLS),
    trained=(2, 4, 8, 16),
    tested=(4, 8, 16),
    draw=draw_tokens,
)
ASSOCIATION = MemoryTest(
    name="association",
    asks="name the value that was shown together with a key",
    level="pairs",
    inputs=PLACES + SYMBOLS + 1,
    answers=SYMBOLS,
    chance=Fraction(1, SYMBOLS),
    trained=(1, 2, 4, 8),
    tested=(2, 4, 8),
    draw=draw_keys_and_values,
)
