"""An env of another suite, by two functions: gymnax's, or what has their shape."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch import validation

# names that params and envs of the suites have for a time limit
_LIMITS = ("max_steps_in_episode", "max_timesteps", "max_steps")


class Outcome(NamedTuple):
    """What one step gives beside observation and state; [N] each, of one env scalars."""

    reward: jax.Array  # float32
    terminated: jax.Array  # bool
    truncated: jax.Array  # bool


class Suite:
    """One env of a suite, by two functions without batch, params or automatic resets.

    Args:
        env: Has ``reset_env`` and ``step_env`` as gymnax's have, or ``reset`` and ``step`` that
            begin no episode by themselves.
        params: Given to both as last argument; None: the env's ``default_params``, or none at all.
        max_steps: Time limit; None: that of the params, or none but the env's own.
    """

    def __init__(self, env: Any, params: Any = None, max_steps: int | None = None) -> None:
        if params is None:
            params = getattr(env, "default_params", None)
        if max_steps is not None:
            max_steps = validation.whole("max_steps", max_steps)
            if max_steps < 1:
                raise ValueError(f"max_steps is {max_steps}, expected 1 or more")
        self.env = env
        self.params = params
        self.extra = () if params is None else (params,)
        self._begin = _function(env, "reset")
        self._go_on = _function(env, "step")
        self.tells_truncation = callable(getattr(env, "is_truncated", None))
        if max_steps is None and not self.tells_truncation:
            max_steps = _limit_of(params)
        self.max_steps = max_steps

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        """The first observation and state of an episode."""
        obs, state = self._begin(key, *self.extra)
        return jax.tree.map(jnp.asarray, obs), jax.tree.map(jnp.asarray, state)

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, count: jax.Array
    ) -> tuple[Any, Any, Outcome]:
        """Take the step number ``count`` of an episode, from 1 on: observation, state, outcome."""
        result = self._go_on(key, state, action, *self.extra)
        if not isinstance(result, tuple) or len(result) not in (5, 6):
            raise TypeError(
                f"step of {name_of(self.env)} gives {described(result)}, expected observation, "
                "state, reward, done (or terminated, truncated), info"
            )
        obs, after, reward = result[:3]
        terminated, truncated = self._ends(result[3:-1], after, count)
        outcome = Outcome(
            jnp.asarray(reward, jnp.float32).reshape(()),
            jnp.asarray(terminated, bool).reshape(()),
            jnp.asarray(truncated, bool).reshape(()),
        )
        return jax.tree.map(jnp.asarray, obs), jax.tree.map(jnp.asarray, after), outcome

    def _ends(self, flags: tuple[Any, ...], after: Any, count: jax.Array) -> tuple[Any, Any]:
        """``terminated`` and ``truncated`` of a step, whatever the env itself tells apart.

        An env that only knows ``done`` is taken to be truncated by an end at the time limit.
        """
        is_limit = jnp.bool_(False) if self.max_steps is None else count >= self.max_steps
        if len(flags) == 2:
            return flags[0], jnp.logical_or(flags[1], is_limit)
        if self.tells_truncation:
            truncated = self.env.is_truncated(after, *self.extra)
            return flags[0], jnp.logical_or(truncated, is_limit)
        return jnp.logical_and(flags[0], jnp.logical_not(is_limit)), is_limit


def _function(env: Any, name: str) -> Callable[..., Any]:
    """``reset_env`` or ``step_env``, else ``reset`` or ``step``."""
    function = getattr(env, f"{name}_env", None) or getattr(env, name, None)
    if not callable(function):
        raise TypeError(
            f"{name_of(env)} has no {name}(key, ...): from_jax takes an env with gymnax's "
            "functions, reset(key, params) -> (obs, state) and "
            "step(key, state, action, params) -> (obs, state, reward, done, info); give another "
            "suite's env these two"
        )
    checked: Callable[..., Any] = function
    return checked


def _limit_of(params: Any) -> int | None:
    """The time limit that params name."""
    for name in _LIMITS:
        limit = getattr(params, name, None)
        if limit is not None:
            return int(limit)
    return None


def name_of(env: Any) -> str:
    """What an env is called in messages."""
    return type(env).__name__


def described(value: Any) -> str:
    """A result in a message: its kind, of a tuple also how many things it holds."""
    size = f" of {len(value)}" if isinstance(value, tuple) else ""
    return f"a {type(value).__name__}{size}"
