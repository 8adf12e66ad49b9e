"""Which cases of a law that holds for all run on every change: a few that differ most from one
another. The others are marked slow and run with `make test-slow`.
"""

import itertools
from collections.abc import Iterable

import pytest

# Continuous dynamics, a board, and the game that takes longest to compile.
GAMES = ("CartPole", "MineSweeper", "Tetris")
# A parallel scan, a loop over steps, a window of past steps, a matrix as state.
MEMORIES = ("lru", "gru", "attention", "mlstm")


def few_games(ids: Iterable[str]) -> list:
    """Ids as parameters of a test, all but those of `GAMES` marked slow."""
    return [_parameter(id, id.startswith(GAMES)) for id in ids]


def few_memories(names: Iterable[str]) -> list:
    """Names of memories as parameters of a test, all but `MEMORIES` marked slow."""
    return few(names, MEMORIES)


def few(values: Iterable, often: Iterable) -> list:
    """Values as parameters of a test, all but those of `often` marked slow."""
    return [_parameter(value, value in often) for value in values]


def a_third(*lists: Iterable) -> list:
    """All combinations of a value of each list as parameters of a test, two thirds marked slow.

    The test says itself that every pair of two values is in a combination that is not slow: it
    depends on how many values the lists have.
    """
    numbered = [list(enumerate(values)) for values in lists]
    cases = []
    for case in itertools.product(*numbered):
        # each list with a step of its own: equal steps would let some pairs never meet
        place = sum(index * (2 if at % 2 else 1) for at, (index, _) in enumerate(case))
        marks = [pytest.mark.slow] if place % 3 else []
        cases.append(pytest.param(*(value for _, value in case), marks=marks))
    return cases


def _parameter(value, often: bool):
    marks = [] if often else [pytest.mark.slow]
    return pytest.param(value, id=str(value), marks=marks)
