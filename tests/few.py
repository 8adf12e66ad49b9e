"""Which cases of a law that holds for all run on every change: a few that differ most from one
another. The others are marked slow and run with `make test-slow`.
"""

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


def _parameter(value, often: bool):
    marks = [] if often else [pytest.mark.slow]
    return pytest.param(value, id=str(value), marks=marks)
