"""The games in pure JAX: importing this loads no torch, and no JAX before it is needed.

Example:
    >>> import jax
    >>> from arcade_torch.envs_jax import make
    >>> game = make("MineSweeperEasy")
    >>> state = game.reset(jax.random.PRNGKey(0))
    >>> game.render(state, partial=False).shape
    (128, 128, 3)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from arcade_torch.envs_jax.registry import (
    OBS_SIZES,
    games_of,
    make,
    option_names,
    probe_ids,
    register,
    registered_ids,
    resolve_id,
)
from arcade_torch.envs_jax.xla_flags import guard_sums

if TYPE_CHECKING:
    from arcade_torch.envs_jax.batch import Batch, BatchedGame, Outcome, env_keys
    from arcade_torch.envs_jax.checks import check_game
    from arcade_torch.envs_jax.game import ACTION_NAMES, NUM_ACTIONS, Game
    from arcade_torch.envs_jax.mixture import MixedGames, Mixture

__all__ = [
    "ACTION_NAMES",
    "NUM_ACTIONS",
    "OBS_SIZES",
    "Batch",
    "BatchedGame",
    "Game",
    "MixedGames",
    "Mixture",
    "Outcome",
    "check_game",
    "env_keys",
    "games_of",
    "make",
    "option_names",
    "probe_ids",
    "register",
    "registered_ids",
    "resolve_id",
]

guard_sums()

if not TYPE_CHECKING:  # a checker is to find misspelt names

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first asked for (PEP 562)."""
        if name in __all__:
            for module in ("batch", "checks", "game", "mixture"):
                public = vars(import_module(f"arcade_torch.envs_jax.{module}"))
                if name in public:
                    return public[name]
        raise AttributeError(f"module 'arcade_torch.envs_jax' has no attribute {name!r}")
