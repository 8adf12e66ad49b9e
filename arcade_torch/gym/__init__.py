"""The games for Gymnasium. Ids and entry points are strings, so that registering them loads neither
JAX nor torch.
"""

from collections.abc import Iterable

import gymnasium

from arcade_torch.envs_jax.registry import on_register

NAMESPACE = "arcade_torch"


def register_games(ids: Iterable[str] = ()) -> None:
    """Put games into Gymnasium's registry, as ``"arcade_torch/<id>"``; those that are there already
    stay.

    The games of the benchmark are there from the beginning, and a game of your own from its
    ``register`` on; this is for probes, which stay out by themselves.

    Args:
        ids: Versioned ids of ``arcade_torch.envs_jax``.

    Example:
        >>> import gymnasium
        >>> register_games(["SignpostEasy-v0"])
        >>> gymnasium.spec("arcade_torch/SignpostEasy-v0").kwargs
        {'game': 'SignpostEasy-v0'}
    """
    for id in ids:
        name = f"{NAMESPACE}/{id}"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="arcade_torch.gym.env:ArcadeGymEnv",
                vector_entry_point="arcade_torch.gym.vector:ArcadeVectorEnv",
                kwargs={"game": id},
            )


on_register(lambda id: register_games([id]))
