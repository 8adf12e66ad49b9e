"""Returns on one scale, by the rule that reproduces the paper's text."""

import re
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

SIGNED_GAMES = ("BattleShip", "MineSweeper", "Breakout", "Tetris", "Navigator")
"""Games whose returns lie in [-1, 1]; the others' lie in [0, 1] already."""

DIFFICULTIES = ("Easy", "Medium", "Hard")

Value = TypeVar("Value", float, NDArray[np.float64])


class Task(NamedTuple):
    """A game at a difficulty; ``difficulty`` is empty for an id of another shape."""

    game: str
    difficulty: str


def split_id(env_id: str) -> Task:
    """Game and difficulty of an environment id.

    Example:
        >>> split_id("MineSweeperEasy-v0")
        Task(game='MineSweeper', difficulty='Easy')
    """
    name = re.sub(r"-v\d+$", "", env_id)
    difficulty = next((level for level in DIFFICULTIES if name.endswith(level)), "")
    game = name.removesuffix(difficulty)
    return Task("NoisyCartPole" if game in ("NoisyPole", "NoisyCartpole") else game, difficulty)


def normalise(env_id: str, value: Value) -> Value:
    """Map a return, or an array of them, to [0, 1]: (x + 1) / 2 for five games, x for the others.

    Args:
        env_id: environment id, with or without version.
        value: raw return.

    Returns:
        The normalised return. Returns outside a game's range stay outside [0, 1].

    Source: POPGym Arcade (ICML 2026), text on the return figure; the rule gives the aggregates that the text quotes.

    Example:
        >>> normalise("TetrisEasy-v0", -0.5), normalise("CartPoleEasy-v0", 0.5)
        (0.25, 0.5)
    """
    return (value + 1) / 2 if split_id(env_id).game in SIGNED_GAMES else value
