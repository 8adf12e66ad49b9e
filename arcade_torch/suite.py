"""An env of another suite, by two functions: gymnax's, or what has their shape."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arcade_torch import validation
from arcade_torch.envs_jax.settings import is_key
from arcade_torch.envs_jax.tracing import ContractError, check_same, leaves, traced
from arcade_torch.envs_jax.validation import kind_of

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
        if isinstance(params, int | float):
            raise TypeError(
                f"params is {params}, expected those of the env: pass num_envs= by name"
            )
        if params is None:
            params = getattr(env, "default_params", None)
        if max_steps is not None:
            max_steps = validation.whole("max_steps", max_steps)
            if max_steps < 1:
                raise ValueError(f"max_steps is {max_steps}, expected 1 or more")
        self.env = env
        self.params = params
        self.extra = () if params is None else (params,)
        self._reset_function = _function(env, "reset")
        self._step_function = _function(env, "step")
        self.tells_truncation = callable(getattr(env, "is_truncated", None))
        if max_steps is None and not self.tells_truncation:
            max_steps = _limit_of(params)
        self.max_steps = max_steps
        # whether truncations may come before max_steps; the trace of a step shows both flags
        self.truncates_itself = self.tells_truncation

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        """The first observation and state of an episode."""
        result = self._reset_function(key, *self.extra)
        if not isinstance(result, tuple | list) or len(result) != 2:
            raise ContractError(
                f"reset of {name_of(self.env)} gives {described(result)}, expected a tuple of "
                "observation and state"
            )
        obs, state = result
        return jax.tree.map(_array, obs), jax.tree.map(_array, state)

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, count: jax.Array
    ) -> tuple[Any, Any, Outcome]:
        """Take the step number ``count`` of an episode, from 1 on: observation, state, outcome."""
        result = self._step_function(key, state, action, *self.extra)
        if not isinstance(result, tuple) or len(result) not in (5, 6):
            raise ContractError(
                f"step of {name_of(self.env)} gives {described(result)}, expected observation, "
                "state, reward, done (or terminated, truncated), info"
            )
        obs, after = result[:2]
        reward, *flags = (self._number(value) for value in result[2:-1])
        if reward.dtype == bool and flags[0].dtype != bool:
            raise ContractError(
                f"step of {name_of(self.env)} gives {reward.dtype} as the reward and "
                f"{flags[0].dtype} as an end, expected observation, state, reward, done, info in "
                "this order"
            )
        terminated, truncated = self._ends([flag.astype(bool) for flag in flags], after, count)
        outcome = Outcome(reward.astype(jnp.float32), terminated, truncated)
        return jax.tree.map(_array, obs), jax.tree.map(_array, after), outcome

    def check(self, action: Any) -> None:
        """Refuse an env whose functions do not fit together; nothing is compiled.

        Args:
            action: Shape and type of the action of one env, a ``jax.ShapeDtypeStruct``.

        Raises:
            TypeError: ``reset`` or ``step`` gives something else than it has to.
            ValueError: One cannot be traced or is not pure, or ``step`` gives an observation or a
                state with other arrays than ``reset``.
        """
        name = name_of(self.env)
        key = jax.ShapeDtypeStruct((2,), jnp.uint32)
        obs, state = traced(name, "reset", self.reset, key)
        count = jax.ShapeDtypeStruct((), jnp.int32)
        following, after, _ = traced(name, "step", self.step, key, state, action, count)
        check_same(name, "observation", obs, following)
        for place, leaf in leaves(obs, "observation").items():
            if is_key(leaf) or leaf.dtype.kind not in "biuf":  # V: bfloat16, int4, ...; c: complex
                raise TypeError(
                    f"{name}: reset shows {place} as {leaf.dtype}, which torch does not share: "
                    "give float32"
                )
            if leaf.dtype.kind == "u" and leaf.dtype.itemsize > 1:
                raise TypeError(
                    f"{name}: reset shows {place} as {leaf.dtype}, of which tensordict clones "
                    "nothing, so that SerialEnv fails: give int32 or float32"
                )
        structure: object = jax.tree.structure(state)
        is_stateless = not jax.tree.leaves(state)  # a bandit
        if not is_stateless or structure != jax.tree.structure(after):
            check_same(name, "state", state, after)

    def _number(self, value: Any) -> jax.Array:
        """A reward or a flag as a scalar array."""
        is_one = hasattr(value, "dtype") or isinstance(value, bool | int | float)
        array = jnp.asarray(value) if is_one else None
        if array is None or array.size != 1:
            given = described(value) if array is None else f"{array.dtype} {list(array.shape)}"
            raise ContractError(
                f"step of {name_of(self.env)} gives {given} as a reward or an end, expected one "
                "number: envs of several agents are not taken"
            )
        return array.reshape(())

    def _ends(self, flags: list[jax.Array], after: Any, count: jax.Array) -> tuple[Any, Any]:
        """``terminated`` and ``truncated`` of a step, whatever the env itself tells apart.

        An env that only knows ``done`` is taken to be truncated by an end at the time limit.
        """
        is_limit = jnp.bool_(False) if self.max_steps is None else count >= self.max_steps
        if len(flags) == 2:
            self.truncates_itself = True
            return flags[0], jnp.logical_or(flags[1], is_limit)
        if self.tells_truncation:
            truncated = self._number(self.env.is_truncated(after, *self.extra))
            return flags[0], jnp.logical_or(truncated, is_limit)
        return jnp.logical_and(flags[0], jnp.logical_not(is_limit)), is_limit


def _array(value: Any) -> Any:
    """An array of a type that does not give way to others, as that of a Python number does: the
    types that a step gives must not hang on where its state comes from.
    """
    array = jnp.asarray(value)
    return array if is_key(array) else jax.lax.convert_element_type(array, array.dtype)


def _function(env: Any, name: str) -> Callable[..., Any]:
    """``reset_env`` or ``step_env``, else ``reset`` or ``step``.

    A wrapper that defines ``step`` and hands on ``step_env`` of what it wraps, and a subclass that
    overrides ``step`` alone, are refused: what they do would be left out.
    """
    if hasattr(env, f"{name}_env") and _depth(env, name) < _depth(env, f"{name}_env"):
        raise TypeError(
            f"{name_of(env)} has a {name} of its own, but {name}_env is that of what it wraps or "
            f"is derived from, and from_jax calls {name}_env, for gymnax's {name} begins episodes "
            f"by itself: hand over what it wraps, or give {name_of(env)} its own {name}_env"
        )
    function = getattr(env, f"{name}_env", None) or getattr(env, name, None)
    if not callable(function):
        raise TypeError(
            f"{name_of(env)} has no {name}(key, ...): from_jax takes an env with gymnax's "
            "functions, reset(key, params) -> (obs, state) and "
            "step(key, state, action, params) -> (obs, state, reward, done, info); give another "
            "suite's env these two"
        )
    if isinstance(env, type) and inspect.isfunction(inspect.getattr_static(env, name, None)):
        raise TypeError(f"env is the class {env.__name__}, expected an env: pass {env.__name__}()")
    checked: Callable[..., Any] = function
    return checked


def _depth(env: Any, name: str) -> int:
    """How far from an object something that it has is defined: in itself, its class, the bases in
    their order, or somewhere else, to which ``__getattr__`` leads.
    """
    places = [vars(env) if hasattr(env, "__dict__") else {}, *map(vars, type(env).__mro__)]
    for depth, place in enumerate(places):
        if name in place:
            return depth
    return len(places)


def _limit_of(params: Any) -> int | None:
    """The time limit that params name, a mapping or an object."""
    entries = params if isinstance(params, Mapping) else None
    for name in _LIMITS:
        limit = getattr(params, name, None) if entries is None else entries.get(name)
        if limit is None or limit == float("inf"):
            continue
        if limit < 1:
            raise ValueError(
                f"params have {name} {limit}, expected a time limit of 1 or more: set it to None "
                "where there is none, or pass max_steps="
            )
        return int(limit)
    return None


def name_of(env: Any) -> str:
    """What an env is called in messages."""
    return type(env).__name__


def described(value: Any) -> str:
    """A result in a message: its kind, of a tuple also how many things it holds."""
    size = f" of {len(value)}" if isinstance(value, tuple) else ""
    return f"{kind_of(value)}{size}"
