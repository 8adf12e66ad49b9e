"""Returns on one scale, by the rule that reproduces the paper's text."""

import re
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

SIGNED_GAMES = ("BattleShip", "MineSweeper", "Breakout", "Tetris", "Navigator")
"""Games whose returns lie in [-1, 1]; the others' lie in [0, 1] already."""

DIFFICULTIES = ("Easy", "Medium", "Hard")

Value = TypeVar("Value", float, NDArray[np.float64])


def game_of(env_id: str) -> str:
    """The game of an environment id, without difficulty and version.

    Example:
        >>> game_of("MineSweeperEasy-v0")
        'MineSweeper'
    """
    game = re.sub(rf"({'|'.join(DIFFICULTIES)})?(-v\d+)?$", "", env_id)
    return "NoisyCartPole" if game in ("NoisyPole", "NoisyCartpole") else game


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
    return (value + 1) / 2 if game_of(env_id) in SIGNED_GAMES else value
