"""Many episodes at once: per-env keys, auto-reset, and one drawing a step.

Every env carries its own random key, so env ``i`` of a large batch walks the very path it walks
alone, and stepping then resetting by mask gives the same bits as the fused step.
"""

from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.checks import check_foreign
from arcade_torch.envs_jax.game import (
    ENDS,
    UNSET,
    Array,
    Game,
    as_actions,
    keeps_ends,
    laid_out_as,
)
from arcade_torch.envs_jax.settings import compiled, fixed, is_key, may_be_nan, raw_key
from arcade_torch.envs_jax.validation import check_num_envs, format_value, plain

State = TypeVar("State")


class Batch(NamedTuple):
    """Everything that is known about N running episodes."""

    key: Array  # uint32 [N, 2], advanced by every step and every reset of its env
    state: Any  # the game's state, leaves [N, ...]
    partial: Array  # bool [N], true where the player sees the POMDP twin
    # int32 [N], the action that led here; survives resets, 0 before the first step
    last_action: Array
    step_count: Array  # int32 [N], steps since the episode began
    episode_reward: Array  # float32 [N], undiscounted return so far
    # bool [N], whether the game has ended, where the state does not say it
    terminated: Array = UNSET
    # bool [N], whether the time limit was reached, where the state does not say it
    truncated: Array = UNSET


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
        first: Index of the first env; the key of env ``i`` depends on ``seed`` and ``first + i``
            alone.

    Returns:
        uint32 [num_envs, 2].

    Raises:
        TypeError: The seed or the number is no whole number.
        ValueError: The seed or the number is out of range.

    Example:
        >>> bool((env_keys(3, 8)[5:] == env_keys(3, 3, first=5)).all())
        True
    """
    seed = plain(seed)
    if not isinstance(seed, int) or isinstance(seed, bool):
        raise TypeError(
            f"seed is {format_value(seed)}, expected a whole number from 0 to 4294967295"
        )
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed is {seed}, allowed: 0 to 4294967295")
    num_envs = check_num_envs(num_envs)
    index = jnp.arange(first, first + num_envs, dtype=jnp.uint32)
    of_seed = jnp.array([0, seed], jnp.uint32)  # threefry's, whatever JAX is told to add to seeds
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(of_seed, index)


def choose_rows(mask: Array, yes: Any, no: Any) -> Any:
    """Choose whole rows of two pytrees, all leaves [N, ...], by a bool [N] mask."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, yes, no)


class BatchedGame(Generic[State]):
    """Compiled functions over a batch of one game; each is compiled once per batch size.

    ``MixedGames`` is the same for several games.

    Args:
        game: The game to batch.

    Attributes:
        game: The same.
        groups: The batches of one game that this one is put together from: itself.

    Raises:
        ValueError: It is not one of this package and does not keep the contract; see
            ``check_game``.
    """

    groups: tuple["BatchedGame[Any]", ...]

    def __init__(self, game: Game[State]) -> None:
        check_foreign(game)
        self.game = game
        self.groups = (self,)
        self._compile()

    def _compile(self) -> None:
        """Compile what users call; inside of compiled functions the plain methods are called."""
        self.init = compiled(self._init)
        self.step = compiled(self._step)
        self.render = compiled(self._render)
        self.facts = may_be_nan(compiled(self._facts))
        self.reset_where = compiled(self._reset_where)
        self.reset_render = compiled(self._reset_render)
        self.step_autoreset = compiled(self._step_autoreset)
        self.step_auto = self.step_autoreset  # the name until 0.2
        self.step_render = compiled(self._step_render)

    def _init(self, keys: Array, partial: Array) -> Batch:
        """Begin N episodes from ``keys`` (uint32 [N, 2]), seen as ``partial`` says (bool [N])."""
        key, first = _split(raw_key(keys, ndim=2))
        state = jax.vmap(self.game.reset)(first)
        zeros = jnp.zeros(keys.shape[0], jnp.int32)
        batch = Batch(key, state, jnp.asarray(partial), zeros, zeros, zeros.astype(jnp.float32))
        batch = with_flags(batch)
        laid_out: Batch = laid_out_as(key[:, 0], batch)
        return laid_out

    def blank(self, keys: Array, partial: Array) -> Batch:
        """N envs in which nothing has begun: zeros in the shapes of ``init``, without flags of an
        end, and nothing is compiled.

        ``reset_where`` or ``reset_render`` of all of them begins the episodes that ``init`` begins.
        """

        def begun(keys: Array, partial: Array) -> Batch:
            return self.without_ends(self.init(keys, partial))

        zeros: Batch = jax.tree.map(_zeros, jax.eval_shape(begun, keys, partial))
        return zeros._replace(key=jnp.asarray(keys), partial=jnp.asarray(partial))

    def _step(self, batch: Batch, action: Array) -> tuple[Batch, Outcome]:
        """Take one action in every env. What comes has the flags of an end, whether the batch has
        them or not.

        An episode that has ended stays as it is: state, counts and both flags, with the reward 0,
        and its random key. Its last action is the given one, as in every env.
        """
        action = as_actions(action, batch.step_count.shape)
        stepped, outcome = self._step_running(self.without_ends(batch), action)
        if not has_ends(batch):
            return stepped, outcome
        batch = with_flags(batch)._replace(last_action=action)
        terminated, truncated = self.ends(batch)
        ended = jnp.logical_or(terminated, truncated)
        held = Outcome(jnp.zeros_like(outcome.reward), terminated, truncated, ended)
        return choose_rows(ended, batch, stepped), choose_rows(ended, held, outcome)

    def _step_running(self, batch: Batch, action: Array) -> tuple[Batch, Outcome]:
        """Take one action in every env of a batch without flags."""
        key, now = _split(batch.key)
        state, reward, terminated, truncated = jax.vmap(self.game.step)(now, batch.state, action)
        stepped = batch._replace(
            key=key,
            state=state,
            last_action=action,
            step_count=batch.step_count + 1,
            episode_reward=batch.episode_reward + reward,
        )
        outcome = Outcome(reward, terminated, truncated, terminated | truncated)
        return self.with_ends(stepped, terminated, truncated), outcome

    def _reset_where(self, batch: Batch, mask: Array) -> Batch:
        """Begin a new episode where ``mask`` (bool [N]) is true; all other rows keep their bits."""
        key, first = _split(batch.key)
        state = jax.vmap(self.game.reset)(first)
        zeros = jnp.zeros_like(batch.step_count)
        fresh = Batch(
            key, state, batch.partial, batch.last_action, zeros, zeros.astype(jnp.float32)
        )
        if has_ends(batch):
            return Batch(*choose_rows(mask, with_flags(fresh), with_flags(batch)))
        return Batch(*choose_rows(mask, self.without_ends(fresh), self.without_ends(batch)))

    def _render(self, batch: Batch) -> Array:
        """Draw every env: uint8 [N, S, S, 3]."""
        return jax.vmap(self.game.render)(batch.state, batch.partial)

    def _facts(self, batch: Batch) -> dict[str, Array]:
        """The facts of every env, see :meth:`Game.facts`: arrays [N, ...] that share no memory with
        the batch.
        """
        facts: dict[str, Array] = jax.vmap(self.game.facts)(batch.state)
        return facts

    def _step_autoreset(self, batch: Batch, action: Array) -> tuple[Batch, Batch, Outcome, Array]:
        """Step, begin anew where an episode ended, then draw once.

        Returns:
            The batch to go on with, the batch before the resets (its ended rows are the final
            states), what the step gave, and the frames of the first.
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

    def without_ends(self, batch: Batch) -> Batch:
        """The batch without the flags of an end: it says by its structure that every episode runs.

        A step of such a batch has nothing to hold, so it is faster. Resetting gives one again.
        """
        if keeps_ends(batch.state):
            batch = batch._replace(state=batch.state._replace(terminated=UNSET, truncated=UNSET))
        return batch._replace(terminated=UNSET, truncated=UNSET)

    def with_ends(self, batch: Batch, terminated: Array, truncated: Array) -> Batch:
        """The batch with the flags of an end, bool [N] each."""
        if keeps_ends(batch.state):
            return batch._replace(
                state=batch.state._replace(terminated=terminated, truncated=truncated)
            )
        return batch._replace(terminated=terminated, truncated=truncated)

    def ends(self, batch: Batch) -> tuple[Array, Array]:
        """``terminated`` and ``truncated`` of a batch that has flags, bool [N] each."""
        keeper = _keeper(batch)
        return keeper.terminated, keeper.truncated

    def rows(self, num_envs: int) -> tuple[slice, ...]:
        """The envs of each game of the batch: here all."""
        return (slice(0, num_envs),)

    def task(self, num_envs: int) -> npt.NDArray[np.int64]:
        """The index of the game that each env plays, int64 [num_envs]: here 0."""
        return np.zeros(num_envs, np.int64)

    def states(self, state: Any) -> tuple[Any, ...]:
        """The states of each game's own envs."""
        return (state,)

    def pad(self, batch: Batch) -> Batch:
        """The batch with all leaves [N, ...], which it has; see ``MixedGames``."""
        return batch

    def unpad(self, batch: Batch) -> Batch:
        """The inverse of ``pad``."""
        return batch


def with_flags(batch: Batch) -> Batch:
    """The batch with the flags of an end, false where it has none.

    They belong in the state if that keeps them, else in the batch.
    """
    no = jnp.zeros(batch.step_count.shape, bool)
    keeper = _keeper(batch)
    flags = {name: no for name in ENDS if getattr(keeper, name) is UNSET}
    if not keeps_ends(batch.state):
        return batch._replace(**flags)
    state = batch.state._replace(**flags)
    return batch._replace(state=state, terminated=UNSET, truncated=UNSET)


def has_ends(batch: Batch) -> bool:
    """Whether a batch of one game has a flag of an end; if not, every episode runs."""
    return any(getattr(_keeper(batch), name) is not UNSET for name in ENDS)


def _keeper(batch: Batch) -> Any:
    """What of a batch of one game has the flags of an end: its state, or itself."""
    return batch.state if keeps_ends(batch.state) else batch


def _zeros(leaf: Any) -> Array:
    """Zeros of the shape and type of a leaf."""
    if is_key(leaf):
        return jnp.zeros(leaf.shape, leaf.dtype)
    return jnp.asarray(np.zeros(leaf.shape, leaf.dtype))  # jnp.zeros would compile for every shape


@partial(jax.vmap, out_axes=0)
def _split(key: Array) -> tuple[Array, Array]:
    """Split one key into the key to keep and the key to use."""
    keep, use = jax.random.split(key)
    return keep, use
