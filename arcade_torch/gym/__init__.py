"""The games for Gymnasium. Ids and entry points are strings, so that registering them loads neither JAX nor torch."""

from collections.abc import Iterable

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
                entry_point="arcade_torch.gym.env:ArcadeGymEnv",
                vector_entry_point="arcade_torch.gym.vector:ArcadeVectorEnv",
                kwargs={"game": id},
            )
