"""A game under gymnax's signatures, so that a training script written for gymnax takes it. Needs no
gymnax.

Example:
    >>> env, params = make("CartPoleEasy")
    >>> obs, state = env.reset(jax.random.PRNGKey(0), params)
    >>> obs, state, reward, done, info = env.step(jax.random.PRNGKey(1), state, 2, params)
    >>> env.observation_space(params).shape, env.action_space(params).n
    ((128, 128, 3), 5)
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax import registry
from arcade_torch.envs_jax.game import Array, Game
from arcade_torch.envs_jax.settings import fixed, raw_key
from arcade_torch.envs_jax.validation import check_choice, format_value

Stepped = tuple[Array, Any, Array, Array, dict[str, Array]]


class EnvParams(NamedTuple):
    """What may differ from call to call: a pytree to trace, and hashable as it stands, so that it
    may be static too.
    """

    partial: Array | bool  # true shows the POMDP twin; vmap over it to have both twins in one batch
    max_steps_in_episode: int  # for scripts that read it: the game keeps its own time limit

    def replace(self, **changes: Any) -> "EnvParams":
        """The parameters with some of them changed.

        Args:
            **changes: ``partial``; ``max_steps_in_episode`` may be named too, but only as it is.

        Raises:
            TypeError: There is no such parameter.
            ValueError: Another ``max_steps_in_episode``.
        """
        unknown = sorted(set(changes) - set(self._fields))
        if unknown:
            raise TypeError(f"params have no {unknown[0]!r}, allowed: {', '.join(self._fields)}")
        limit = changes.get("max_steps_in_episode", self.max_steps_in_episode)
        if limit is not self.max_steps_in_episode and limit != self.max_steps_in_episode:
            raise ValueError(
                f"max_steps_in_episode is {format_value(limit)}, allowed: "
                f"{self.max_steps_in_episode}, the game's own time limit; end episodes earlier by "
                "a wrapper"
            )
        return self._replace(**changes)


class Discrete(NamedTuple):
    """The integers below ``n``."""

    n: int
    shape: tuple[int, ...] = ()
    dtype: Any = jnp.int32

    @fixed
    def sample(self, key: Array) -> Array:
        """One of them, each as likely: int32 []."""
        return jax.random.randint(raw_key(key), self.shape, 0, self.n, self.dtype)

    def contains(self, x: Any) -> Array:
        """Whether ``x`` is one of them: bool []."""
        return (jnp.asarray(x) >= 0) & (jnp.asarray(x) < self.n)


class Box(NamedTuple):
    """Arrays of one shape, all elements from ``low`` to ``high``."""

    low: int
    high: int
    shape: tuple[int, ...]
    dtype: Any

    @fixed
    def sample(self, key: Array) -> Array:
        """One of them, each as likely."""
        return jax.random.randint(raw_key(key), self.shape, self.low, self.high + 1).astype(
            self.dtype
        )

    def contains(self, x: Any) -> Array:
        """Whether no element of ``x`` is outside: bool []."""
        return ((jnp.asarray(x) >= self.low) & (jnp.asarray(x) <= self.high)).all()


class GymnaxEnv:
    """One env: pure functions to put under ``jit``, ``vmap`` and ``scan``. State is the game's own.

    Args:
        game: What ``arcade_torch.envs_jax.make`` gave.
        observability: Which twin ``default_params`` shows, ``"full"`` (MDP) or ``"partial"``
            (POMDP).

    Raises:
        ValueError: Another word.
    """

    def __init__(self, game: Game[Any], observability: str = "full") -> None:
        check_choice("observability", observability, ("full", "partial"))
        self.game = game
        self.name = game.id
        self.num_actions = game.num_actions
        self.default_params = EnvParams(observability == "partial", game.max_steps)

    def action_space(self, params: EnvParams | None = None) -> Discrete:
        """What ``step`` takes: up, down, left, right, fire."""
        return Discrete(self.num_actions)

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """What the env shows: uint8 [S, S, 3], rows downwards, RGB."""
        return Box(0, 255, (self.game.obs_size, self.game.obs_size, 3), jnp.uint8)

    def get_obs(self, state: Any, params: EnvParams | None = None) -> Array:
        """Draw a state: uint8 [S, S, 3]."""
        return self.game.render(state, (params or self.default_params).partial)

    @fixed
    def reset(self, key: Array, params: EnvParams | None = None) -> tuple[Array, Any]:
        """Begin an episode.

        Args:
            key: uint32 [2], a JAX random key, or one of ``jax.random.key``.
            params: ``default_params`` unless given.

        Returns:
            The observation, uint8 [S, S, 3], and the state.
        """
        state = self.game.reset(key)
        return self.get_obs(state, params), state

    @fixed
    def step(
        self, key: Array, state: Any, action: Array | int, params: EnvParams | None = None
    ) -> Stepped:
        """Take one action; where that ends the episode, go on with the first observation of a new
        one.

        Args:
            key: uint32 [2], a JAX random key for this step alone.
            state: The state before.
            action: int32 [], 0 to 4: up, down, left, right, fire.
            params: ``default_params`` unless given.

        Returns:
            Observation, state, reward (float32 []), done (bool []), and info: ``terminated`` and
            ``truncated`` (bool []), and ``discount`` (float32 []), 0 where the game itself ended
            and 1 elsewhere, also at a time limit.
        """
        following, _, outcome = self.game.step_autoreset(key, state, jnp.asarray(action))
        return self._stepped(following, outcome, params)

    @fixed
    def step_env(
        self, key: Array, state: Any, action: Array | int, params: EnvParams | None = None
    ) -> Stepped:
        """``step`` without the new episode: an end shows the final observation."""
        following, *outcome = self.game.step(key, state, jnp.asarray(action))
        return self._stepped(following, outcome, params)

    def _stepped(self, state: Any, outcome: Any, params: EnvParams | None) -> Stepped:
        reward, terminated, truncated = outcome
        info = {"discount": 1.0 - terminated, "terminated": terminated, "truncated": truncated}
        return self.get_obs(state, params), state, reward, terminated | truncated, info


def make(id: str, observability: str = "full", **options: Any) -> tuple[GymnaxEnv, EnvParams]:
    """Make an env and its parameters, as ``gymnax.make`` does.

    Args:
        id: Id of the game, such as ``"CartPoleEasy"``.
        observability: ``"full"`` (MDP) or ``"partial"`` (POMDP).
        **options: ``obs_size``, ``rules``, and options of the game; see
            ``arcade_torch.envs_jax.make``.

    Raises:
        ValueError: Unknown id, observability, size, rules or option value.
        TypeError: An option the game does not have.
    """
    env = GymnaxEnv(registry.make(id, **options), observability)
    return env, env.default_params
