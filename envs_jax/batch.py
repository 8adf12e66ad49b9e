"""Many episodes at once: per-env keys, auto-reset, and one drawing a step.

Every env carries its own random key, so env ``i`` of a large batch walks the very path it walks alone, and stepping
then resetting by mask gives the same bits as the fused step.
"""

import abc
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.checks import check_foreign
from arcade_torch.envs_jax.game import ENDS, UNSET, Array, Game, keeps_ends, stay
from arcade_torch.envs_jax.settings import compiled, fixed, raw_key
from arcade_torch.envs_jax.validation import format_value, plain

State = TypeVar("State")


class Batch(NamedTuple):
    """Everything that is known about N running episodes."""

    key: Array  # uint32 [N, 2], advanced by every step and every reset of its env
    state: Any  # the game's state, leaves [N, ...]
    partial: Array  # bool [N], true where the player sees the POMDP twin
    last_action: Array  # int32 [N], the action that led here; survives resets, 0 before the first step
    step_count: Array  # int32 [N], steps since the episode began
    episode_reward: Array  # float32 [N], undiscounted return so far
    terminated: Array = UNSET  # bool [N], whether the game has ended, where the state does not say it
    truncated: Array = UNSET  # bool [N], whether the time limit was reached, where the state does not say it


class Outcome(NamedTuple):
    """What one step gave."""

    reward: Array  # float32 [N]
    terminated: Array  # bool [N], the game's own end
    truncated: Array  # bool [N], the time limit
    done: Array  # bool [N], terminated or truncated


@fixed
def env_keys(seed: int, num_envs: int, first: int = 0) -> Array:
    """Random keys for a batch of envs.

    Args:
        seed: Seed of the whole batch, 0 <= seed < 2**32.
        num_envs: Number of envs.
        first: Index of the first env; the key of env ``i`` depends on ``seed`` and ``first + i`` alone.

    Returns:
        uint32 [num_envs, 2].

    Raises:
        TypeError: The seed is no whole number.
        ValueError: The seed is out of range.

    Example:
        >>> bool((env_keys(3, 8)[5:] == env_keys(3, 3, first=5)).all())
        True
    """
    seed = plain(seed)
    if not isinstance(seed, int) or isinstance(seed, bool):
        raise TypeError(f"seed is {format_value(seed)}, expected a whole number from 0 to 4294967295")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed is {seed}, allowed: 0 to 4294967295")
    index = jnp.arange(first, first + num_envs, dtype=jnp.uint32)
    of_seed = jnp.array([0, seed], jnp.uint32)  # threefry's, whatever JAX is told to add to seeds
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(of_seed, index)


def choose_rows(mask: Array, yes: Any, no: Any) -> Any:
    """Choose whole rows of two pytrees, all leaves [N, ...], by a bool [N] mask."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, yes, no)


class Steps(abc.ABC):
    """What a batch of one game and a batch of several do alike, put together from stepping, resetting and drawing."""

    def __init__(self) -> None:
        self.init = compiled(self._init)
        self.step = compiled(self._step)
        self.render = compiled(self._render)
        self.reset_where = compiled(self._reset_where)
        self.reset_render = compiled(self._reset_render)
        self.step_auto = compiled(self._step_auto)
        self.step_render = compiled(self._step_render)

    @abc.abstractmethod
    def _init(self, keys: Array, partial: Array) -> Batch:
        """Begin N episodes from ``keys`` (uint32 [N, 2]), seen as ``partial`` says (bool [N])."""

    @abc.abstractmethod
    def _step(self, batch: Batch, action: Array) -> tuple[Batch, Outcome]:
        """Take one action in every env.

        An episode that has ended stays as it is: state, counts and both flags, with the reward 0, and its random key.
        """

    @abc.abstractmethod
    def _reset_where(self, batch: Batch, mask: Array) -> Batch:
        """Begin a new episode where ``mask`` (bool [N]) is true; all other rows keep their bits."""

    @abc.abstractmethod
    def _render(self, batch: Batch) -> Array:
        """Draw every env: uint8 [N, S, S, 3]."""

    def _step_auto(self, batch: Batch, action: Array) -> tuple[Batch, Batch, Outcome, Array]:
        """Step, begin anew where an episode ended, then draw once.

        Returns:
            The batch to go on with, the batch before the resets (its ended rows are the final states), what the step
            gave, and the frames of the first.
        """
        stepped, outcome = self._step(batch, action)
        root = self._reset_where(stepped, outcome.done)
        return root, stepped, outcome, self._render(root)

    def _step_render(self, batch: Batch, action: Array) -> tuple[Batch, Outcome, Array]:
        """Step and draw, without any reset."""
        stepped, outcome = self._step(batch, action)
        return stepped, outcome, self._render(stepped)

    def _reset_render(self, batch: Batch, mask: Array) -> tuple[Batch, Array]:
        """Begin anew where ``mask`` is true, and draw all."""
        root = self._reset_where(batch, mask)
        return root, self._render(root)


class BatchedGame(Steps, Generic[State]):
    """Compiled functions over a batch of one game; each is compiled once per batch size.

    Args:
        game: The game to batch.

    Raises:
        ValueError: It is not one of this package and does not keep the contract; see ``check_game``.
    """

    def __init__(self, game: Game[State]) -> None:
        check_foreign(game)
        self.game = game
        super().__init__()

    @property
    def groups(self) -> tuple["BatchedGame[State]", ...]:
        """The games of the batch, here one; see ``MixedGames``."""
        return (self,)

    def rows(self, num_envs: int) -> tuple[slice, ...]:
        """The envs of each game of the batch: here all."""
        return (slice(0, num_envs),)

    def task(self, num_envs: int) -> npt.NDArray[np.int64]:
        """The index of the game that each env plays, int64 [num_envs]: here 0."""
        return np.zeros(num_envs, np.int64)

    def states(self, state: Any) -> tuple[Any, ...]:
        """The states of each game's own envs."""
        return (state,)

    def wide(self, batch: Batch) -> Batch:
        """The batch with all leaves [N, ...], which it has; see ``MixedGames``."""
        return batch

    def narrow(self, batch: Batch) -> Batch:
        """The inverse of ``wide``."""
        return batch

    def _init(self, keys: Array, partial: Array) -> Batch:
        key, first = _split(raw_key(keys, ndim=2))
        state = jax.vmap(self.game.reset)(first)
        zeros = jnp.zeros(keys.shape[0], jnp.int32)
        return with_flags(Batch(key, state, jnp.asarray(partial), zeros, zeros, zeros.astype(jnp.float32)))

    def _step(self, batch: Batch, action: Array) -> tuple[Batch, Outcome]:
        batch = with_flags(batch)
        key, now = _split(batch.key)
        action = jnp.asarray(action, jnp.int32)
        state, reward, terminated, truncated = jax.vmap(self.game.step)(now, batch.state, action)
        ended = _ended(batch)
        if not keeps_ends(batch.state):
            state = stay(ended, batch.state, state)
            reward = jnp.where(ended, jnp.float32(0), reward)
            terminated = jnp.where(ended, batch.terminated, terminated)
            truncated = jnp.where(ended, batch.truncated, truncated)
            batch = batch._replace(terminated=terminated, truncated=truncated)
        stepped = batch._replace(
            key=jnp.where(ended[:, None], batch.key, key),
            state=state,
            last_action=action,
            step_count=batch.step_count + ~ended,
            episode_reward=batch.episode_reward + reward,
        )
        return stepped, Outcome(reward, terminated, truncated, terminated | truncated)

    def _reset_where(self, batch: Batch, mask: Array) -> Batch:
        key, first = _split(batch.key)
        state = jax.vmap(self.game.reset)(first)
        zeros = jnp.zeros_like(batch.step_count)
        fresh = Batch(key, state, batch.partial, batch.last_action, zeros, zeros.astype(jnp.float32))
        return Batch(*choose_rows(mask, with_flags(fresh), with_flags(batch)))

    def _render(self, batch: Batch) -> Array:
        return jax.vmap(self.game.render)(batch.state, batch.partial)


def with_flags(batch: Batch) -> Batch:
    """The batch with the flags of an end where they belong: in the state if that keeps them, else in the batch."""
    no = jnp.zeros(batch.step_count.shape, bool)
    keeper = batch.state if keeps_ends(batch.state) else batch
    flags = {name: no for name in ENDS if getattr(keeper, name) is UNSET}
    if keeper is batch:
        return batch._replace(**flags)
    return batch._replace(state=batch.state._replace(**flags), terminated=UNSET, truncated=UNSET)


def _ended(batch: Batch) -> Array:
    """Which episodes of a batch with flags have ended: bool [N]."""
    keeper = batch.state if keeps_ends(batch.state) else batch
    return jnp.logical_or(keeper.terminated, keeper.truncated)


@partial(jax.vmap, out_axes=0)
def _split(key: Array) -> tuple[Array, Array]:
    """Split one key into the key to keep and the key to use."""
    keep, use = jax.random.split(key)
    return keep, use
