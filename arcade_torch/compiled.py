"""The compiled functions of one game, shared by all envs that play it."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax import Game
from arcade_torch.envs_jax import make as make_game
from arcade_torch.envs_jax.batch import Batch, BatchedGame, Outcome

# Columns of ``Step.numbers``.
REWARD, EPISODE_REWARD, STEP_COUNT, TERMINATED, TRUNCATED = range(5)
NUM_NUMBERS = 5


class Step(NamedTuple):
    """What the fused step computes."""

    root: Batch  # after the resets: the live state, so copy what is exported of it
    final_state: Any  # the game's state before the resets
    outcome: Outcome  # reward float32 [N], terminated, truncated, done bool [N]
    pixels: jax.Array  # uint8 [N, S, S, 3] of the root
    numbers: jax.Array  # float32 [N, 5]: the outcome and the counts before the resets in one array, for one export


class CompiledGame:
    """A batched game and the fused step of the bridge; each is compiled once per number of envs.

    Args:
        game: The game, batched or not.
    """

    def __init__(self, game: Game[Any] | BatchedGame[Any]) -> None:
        self.batched: BatchedGame[Any] = game if isinstance(game, BatchedGame) else BatchedGame(game)
        self.step = jax.jit(self._step)
        self.draw = jax.jit(
            jax.vmap(self.batched.game.render)
        )  # states [K, ...], partial bool [K] -> uint8 [K, S, S, 3]

    def _step(self, batch: Batch, action: jax.Array) -> Step:
        """Step, begin anew where an episode ended, draw once, and pack the numbers."""
        root, stepped, outcome, pixels = self.batched.step_auto(batch, action)
        columns = (outcome.reward, stepped.episode_reward, stepped.step_count, outcome.terminated, outcome.truncated)
        numbers = jnp.stack([jnp.asarray(column, jnp.float32) for column in columns], axis=-1)
        return Step(root, stepped.state, outcome, pixels, numbers)


def compiled_game(id: str, obs_size: int, rules: str, options: dict[str, Any]) -> CompiledGame:
    """Make a game with its compiled functions; equal arguments share them, so a second env compiles nothing.

    Args:
        id: Id of the game.
        obs_size: Side of the frames.
        rules: Rule set.
        options: Options of the game.

    Returns:
        The game.
    """
    try:
        return _cached(id, obs_size, rules, tuple(sorted(options.items())))
    except TypeError as error:
        if "unhashable" not in str(error):
            raise
        return CompiledGame(make_game(id, obs_size=obs_size, rules=rules, **options))


@functools.lru_cache(maxsize=64)
def _cached(id: str, obs_size: int, rules: str, options: tuple[tuple[str, Any], ...]) -> CompiledGame:
    return CompiledGame(make_game(id, obs_size=obs_size, rules=rules, **dict(options)))
