"""One translation a game."""

from importlib import import_module

from arcade_torch.envs_jax.registry import DIFFICULTIES, GAMES
from tests.parity.translation import Translation

TASKS = tuple(game + level for game in GAMES for level in DIFFICULTIES)


def translation_of(task: str) -> Translation:
    """The translation of a task such as ``"NoisyCartPoleHard"``."""
    game = next(game for game in GAMES if task.startswith(game))
    module = import_module(f"tests.parity.translations.{game.lower().removeprefix('noisy')}")
    translation: Translation = module.TRANSLATION
    return translation
