"""The games in pure JAX: importing this loads no torch.

Example:
    >>> import jax
    >>> from arcade_torch.envs_jax import make
    >>> game = make("MineSweeperEasy")
    >>> state = game.reset(jax.random.PRNGKey(0))
    >>> game.render(state, partial=False).shape
    (128, 128, 3)
"""

from arcade_torch.envs_jax import (  # noqa: F401  (importing a game registers it)
    autoencode,
    battleship,
    breakout,
    cartpole,
    countrecall,
    minesweeper,
    navigator,
    signpost,
    skittles,
    tetris,
)
from arcade_torch.envs_jax.batch import Batch, BatchedGame, Outcome, env_keys
from arcade_torch.envs_jax.checks import check_game
from arcade_torch.envs_jax.game import ACTION_NAMES, NUM_ACTIONS, OBS_SIZES, Game
from arcade_torch.envs_jax.mixture import MixedGames, Mixture
from arcade_torch.envs_jax.registry import make, option_names, probe_ids, register, registered_ids, resolve_id

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
    "make",
    "option_names",
    "probe_ids",
    "register",
    "registered_ids",
    "resolve_id",
]
