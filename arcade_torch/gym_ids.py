"""The games in Gymnasium's registry: ids and entry points as strings, so that registering them loads nothing.

Importing ``arcade_torch`` calls :func:`register_when_gymnasium_is_there`: at once if Gymnasium has been imported,
otherwise as soon as somebody imports it. Gymnasium brings numpy along, which would triple the cost of
``import arcade_torch`` for those who do not need it.
"""

import sys
from collections.abc import Iterable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

NAMESPACE = "arcade_torch"
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
DIFFICULTIES = ("Easy", "Medium", "Hard")
# The games' own registry would load JAX; a test holds the two lists together.
BENCHMARK_IDS = tuple(f"{game}{difficulty}-v0" for game in GAMES for difficulty in DIFFICULTIES)


def register_games(ids: Iterable[str] = BENCHMARK_IDS) -> None:
    """Put games into Gymnasium's registry, as ``"arcade_torch/<id>"``; those that are there already stay.

    Args:
        ids: Versioned ids of ``arcade_torch.envs_jax``; for games of your own, call this after their ``register``.

    Example:
        >>> import gymnasium
        >>> register_games(["SignpostEasy-v0"])
        >>> gymnasium.spec("arcade_torch/SignpostEasy-v0").kwargs
        {'game': 'SignpostEasy-v0'}
    """
    import gymnasium

    for id in ids:
        name = f"{NAMESPACE}/{id}"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="arcade_torch.gym_env:ArcadeGymEnv",
                vector_entry_point="arcade_torch.gym_vector:ArcadeVectorEnv",
                kwargs={"game": id},
            )


def register_when_gymnasium_is_there() -> None:
    """Register the games of the benchmark now, or right after the first ``import gymnasium``."""
    if hasattr(sys.modules.get("gymnasium"), "registry"):
        register_games()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    """Finds nothing itself: hands out the spec that the other finders give, and registers after it was executed."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """See :class:`importlib.abc.MetaPathFinder`."""
        if fullname != "gymnasium":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        spec = next((found for finder in others if (found := finder.find_spec(fullname, path, target))), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                register_games()

            # Merely being asked where Gymnasium is (importlib.util.find_spec) changes nothing: this spec is a new one.
            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec
