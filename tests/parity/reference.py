"""The published games, as they are installed, with and without their pictures."""

from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax
import jax.numpy as jnp

PACKAGE = "popgym-arcade"
WANTED = "0.0.7"


def missing() -> str:
    """Why the published package cannot be compared with; empty where it can."""
    try:
        found = version(PACKAGE)
    except PackageNotFoundError:
        return f"needs the parity extra: pip install '.[parity]' ({PACKAGE}=={WANTED})"
    return "" if found == WANTED else f"compares with {PACKAGE} {WANTED}, and {found} is installed"


def published(name: str, *, partial_obs: bool = False, obs_size: int = 128) -> tuple[Any, Any]:
    """A published game and its parameters.

    Args:
        name: such as ``"CartPoleEasy"``.
        partial_obs: the POMDP twin.
        obs_size: side of its pictures.
    """
    return import_module("popgym_arcade").make(name, partial_obs=partial_obs, obs_size=obs_size)


def without_picture(name: str) -> tuple[Any, Any]:
    """A published game that draws nothing: its law alone, which compiles in a second."""
    game, params = published(name)
    nothing = {
        "get_obs": lambda self, *args, **kwargs: jnp.zeros(()),
        "setup_render_templates": lambda self: None,
    }
    return type(type(game).__name__, (type(game),), nothing)(), params


@partial(jax.jit, static_argnums=(0, 2))
def resets(game: Any, key: jax.Array, count: int, params: Any) -> Any:
    """Many first states of a published game, leaves [count, ...]."""
    _, states = jax.vmap(game.reset_env, in_axes=(0, None))(jax.random.split(key, count), params)
    return states
