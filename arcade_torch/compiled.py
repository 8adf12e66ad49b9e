"""The compiled functions of a game or a mixture of games, shared by all envs that play it."""

import functools
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax import Game, MixedGames, resolve_id
from arcade_torch.envs_jax import make as make_game
from arcade_torch.envs_jax.batch import Batch, BatchedGame, Outcome
from arcade_torch.envs_jax.mixture import Batched
from arcade_torch.envs_jax.shown import shown

# Columns of ``Step.numbers``.
REWARD, EPISODE_REWARD, STEP_COUNT, TERMINATED, TRUNCATED = range(5)
NUM_NUMBERS = 5

_Ids = str | tuple[str, ...]


class Step(NamedTuple):
    """What the fused step computes."""

    root: Batch  # after the resets: the live state, so copy what is exported of it
    final_state: Any  # the games' state before the resets
    outcome: Outcome  # reward float32 [N], terminated, truncated, done bool [N]
    pixels: jax.Array  # uint8 [N, S, S, 3] of the root
    numbers: jax.Array  # float32 [N, 5]: the outcome and the counts before the resets in one array, for one export


class CompiledGame:
    """A batched game, or several, and the fused step of the bridge; each is compiled once per number of envs.

    Args:
        game: The game, batched or not, or a mixture.
    """

    def __init__(self, game: Game[Any] | Batched) -> None:
        self.batched: Batched = game if isinstance(game, BatchedGame | MixedGames) else BatchedGame(game)
        self.step = jax.jit(self._step)
        self.draw = self.batched.groups[0].draw  # of the only game, or of the first

    def _step(self, batch: Batch, action: jax.Array) -> Step:
        """Step, begin anew where an episode ended, draw once, and pack the numbers."""
        root, stepped, outcome, pixels = self.batched.step_auto(batch, action)
        columns = (outcome.reward, stepped.episode_reward, stepped.step_count, outcome.terminated, outcome.truncated)
        numbers = jnp.stack([jnp.asarray(column, jnp.float32) for column in columns], axis=-1)
        return Step(root, stepped.state, outcome, pixels, numbers)


def compiled_game(id: str | Sequence[str], obs_size: int, rules: str, options: dict[str, Any]) -> CompiledGame:
    """Make a game with its compiled functions; equal arguments share them, so a second env compiles nothing.

    Args:
        id: Id of the game, or ids of several: a mixture, in which an id that stands there k times gets k shares.
        obs_size: Side of the frames.
        rules: Rule set.
        options: Options of the game; in a mixture, of every game.

    Returns:
        The game.

    Raises:
        ValueError: Unknown id, size, rules or option value, or no id at all.
        TypeError: An option that one of the games does not have, or ids that are neither a string nor a list.
    """
    ids = id if isinstance(id, str) else tuple(_checked(id))
    try:
        return _cached(ids, obs_size, rules, tuple(sorted(options.items())))
    except TypeError as error:
        if "unhashable" not in str(error):
            raise
        return _compile(ids, obs_size, rules, options)


def _checked(ids: Any) -> Sequence[str]:
    """Refuse what is no list of ids."""
    if not isinstance(ids, Sequence) or isinstance(ids, bytes):
        raise TypeError(f"the env id is {shown(ids)}, expected a string such as 'CartPoleEasy', or a list of them")
    if not ids:
        raise ValueError("the list of env ids is empty: name at least one game")
    return [resolve_id(id) for id in ids]


@functools.lru_cache(maxsize=64)
def _cached(ids: _Ids, obs_size: int, rules: str, options: tuple[tuple[str, Any], ...]) -> CompiledGame:
    return _compile(ids, obs_size, rules, dict(options))


def _compile(ids: _Ids, obs_size: int, rules: str, options: dict[str, Any]) -> CompiledGame:
    if isinstance(ids, str):
        return CompiledGame(make_game(ids, obs_size=obs_size, rules=rules, **options))
    shares = Counter(ids)
    games = [make_game(id, obs_size=obs_size, rules=rules, **options) for id in shares]
    return CompiledGame(MixedGames(games, tuple(shares.values())))
