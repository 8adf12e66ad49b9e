"""One translation a game."""

from importlib import import_module

from tests.parity.translation import Translation

GAMES = (
    "AutoEncode",
    "BattleShip",
    "Breakout",
    "CartPole",
    "CountRecall",
    "MineSweeper",
    "Navigator",
    "NoisyCartPole",
    "Skittles",
    "Tetris",
)
LEVELS = ("Easy", "Medium", "Hard")
TASKS = tuple(game + level for game in GAMES for level in LEVELS)


def translation_of(task: str) -> Translation:
    """The translation of a task such as ``"NoisyCartPoleHard"``."""
    game = next(game for game in GAMES if task.startswith(game))
    module = import_module(f"tests.parity.translations.{game.lower().removeprefix('noisy')}")
    translation: Translation = module.TRANSLATION
    return translation
