"""Whether a game keeps the contract of ``Game``: shapes, types and structure, without compiling
anything; on request also what random play shows.
"""

import inspect
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from arcade_torch.envs_jax.game import MEMORY_KINDS, NUM_ACTIONS, ORACLES, Game, keeps_ends
from arcade_torch.envs_jax.settings import KEY_KIND, compiled
from arcade_torch.envs_jax.tracing import check_array, check_same, kind_of_traced, leaves, traced
from arcade_torch.envs_jax.validation import kind_of

_OURS = "arcade_torch.envs_jax."
_STEPS_TO_PLAY = 100  # a running episode is played to its end
_STEPS_BEYOND = 3  # after an end
_ROUNDING = 1e-4  # of a return


def check_game(game: Game[Any], play: bool = False) -> None:
    """Refuse a game whose functions do not fit together, or whose frames nobody could use.

    Traces ``reset``, ``step``, ``render`` and ``facts`` twice each, for shapes and types; that
    takes milliseconds. ``make`` and ``BatchedGame`` call it for every game that is not one of this
    package.

    Args:
        game: The game.
        play: Play random steps too, to the end of an episode and beyond it, and draw both twins at
            every step. That compiles ``reset`` and ``step``, and takes seconds.

    Raises:
        ValueError: A function cannot be traced, depends on what Python keeps between calls, or
            gives something of a wrong shape or type; ``step`` changes the structure of the state;
            or an attribute is missing or of no use. With ``play`` also: a random key is used for
            several draws, a code has no picture, a reward or a state entry is not a number, an
            episode ends too late or is truncated too early, a return is out of range, or the twins
            never differ. One line: the game, what arrived, what is wanted.

    Example:
        >>> from arcade_torch.envs_jax import make
        >>> check_game(make("MineSweeperEasy"), play=True)
    """
    _check_attributes(game)
    name = game.id
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    first = traced(name, "reset", game.reset, key)
    if first is None:
        raise ValueError(f"{name}: reset gives None, wanted a state: a tree of arrays")
    stepped = traced(name, "step", game.step, key, first, jax.ShapeDtypeStruct((), jnp.int32))
    if not isinstance(stepped, tuple) or len(stepped) != 4:
        got = f"{len(stepped)} values" if isinstance(stepped, tuple) else kind_of_traced(stepped)
        raise ValueError(
            f"{name}: step gives {got}, wanted 4: state, reward, terminated, truncated (a tuple)"
        )
    check_same(name, "state", first, stepped[0])
    check_array(name, "step gives reward as", stepped[1], (), "float32")
    check_array(name, "step gives terminated as", stepped[2], (), "bool")
    check_array(name, "step gives truncated as", stepped[3], (), "bool")
    frame = traced(name, "render", game.render, first, jax.ShapeDtypeStruct((), jnp.bool_))
    check_array(name, "render gives", frame, (game.obs_size, game.obs_size, 3), "uint8")
    _check_facts(name, traced(name, "facts", game.facts, first))
    if play:
        _check_keys(game, first)
        _check_play(game)


def _check_facts(name: str, facts: Any) -> None:
    """Refuse facts that are no dictionary of arrays of booleans, integers or float32."""
    if not isinstance(facts, dict):
        raise ValueError(
            f"{name}: facts gives {kind_of_traced(facts)}, wanted a dictionary of arrays by name"
        )
    for fact, value in facts.items():
        if not isinstance(fact, str) or not fact or "." in fact:
            raise ValueError(f"{name}: facts names {fact!r}, wanted a word without a dot")
        dtype = getattr(value, "dtype", None)
        is_class = dtype is not None and (
            dtype == jnp.bool_ or jnp.issubdtype(dtype, jnp.signedinteger)
        )
        if not is_class and dtype != jnp.float32:
            kind = type(value).__name__ if dtype is None else dtype
            raise ValueError(
                f"{name}: facts gives {fact!r} as {kind}, wanted bool or signed integers for a "
                "class, or float32 for a number"
            )


def _check_keys(game: Game[Any], state: Any) -> None:
    """Refuse a ``reset`` or ``step`` that uses one random key for several draws, as far as JAX
    sees it.
    """
    key = jax.random.key(0, impl=KEY_KIND)  # JAX follows keys of this style alone
    calls = {"reset": (key,), "step": (key, state, jax.ShapeDtypeStruct((), jnp.int32))}
    for method, given in calls.items():
        plain = inspect.unwrap(getattr(type(game), method))  # the wrapper takes the key apart
        call = compiled(lambda *arrays, plain=plain: plain(game, *arrays))
        try:
            with jax.debug_key_reuse(True):
                call.trace(*given)
        except jax.errors.KeyReuseError:
            raise ValueError(
                f"{game.id}: {method} uses a random key twice, so that its draws hang "
                "together: jax.random.split gives a key for each draw"
            ) from None
        except Exception:  # it takes keys of the other style alone, and is checked by play
            continue


def _check_play(game: Game[Any]) -> None:
    """Play episodes at random until enough steps have been played."""
    reset = compiled(game.reset)
    step = compiled(game.step)
    steps = 0
    episodes = 0
    differ = False
    while steps < _STEPS_TO_PLAY:
        length, differs = _check_episode(game, reset, step, seed=episodes)
        steps += length
        differ |= differs
        episodes += 1
    if not differ:
        raise ValueError(
            f"{game.id}: render gives both twins the same frames in {steps} steps at random: where "
            "partial is true it has to hide something that the MDP shows"
        )


def _check_episode(game: Game[Any], reset: Any, step: Any, seed: int) -> tuple[int, bool]:
    """Play one episode at random, to the end and beyond; returns its length, and whether the frames
    of the twins differ anywhere.
    """
    actions = np.random.default_rng(seed)
    state = reset(_key(seed, 0))
    differs = _check_frames(game, state, 0)
    episode_return = 0.0
    length = 0
    done = False
    while not done:
        length += 1
        action = actions.integers(NUM_ACTIONS, dtype=np.int32)
        state, reward, terminated, truncated = step(_key(seed, length), state, action)
        _check_numbers(game, state, reward, length)
        differs |= _check_frames(game, state, length)
        episode_return += float(reward)
        done = bool(terminated) or bool(truncated)
        if not done and length >= game.max_steps:
            raise ValueError(
                f"{game.id}: neither terminated nor truncated up to step {length}, and max_steps "
                f"is {game.max_steps}"
            )
        if truncated and length < game.max_steps:
            raise ValueError(
                f"{game.id}: truncated in step {length}, and max_steps is {game.max_steps}"
            )
    lowest, highest = game.return_range
    if not lowest - _ROUNDING <= episode_return <= highest + _ROUNDING:
        raise ValueError(
            f"{game.id}: an episode returned {episode_return:.6g}, and return_range is "
            f"{game.return_range}"
        )
    if keeps_ends(state):  # other states are not stepped any more
        for beyond in range(length + 1, length + 1 + _STEPS_BEYOND):
            action = actions.integers(NUM_ACTIONS, dtype=np.int32)
            state = step(_key(seed, beyond), state, action)[0]
            _check_frames(game, state, beyond)
    return length, differs


def _key(seed: int, step: int) -> npt.NDArray[np.uint32]:
    """A random key for one step of one episode."""
    return np.array([seed, step], np.uint32)


def _check_frames(game: Game[Any], state: Any, steps: int) -> bool:
    """Draw both twins, not compiled, so that ``Layers`` sees the codes; whether they differ."""
    try:
        full = game.render(state, jnp.bool_(False))
        partial = game.render(state, jnp.bool_(True))
    except ValueError as error:
        raise ValueError(f"{game.id}: render after step {steps}: {error}") from error
    return not np.array_equal(full, partial)


def _check_numbers(game: Game[Any], state: Any, reward: Any, step: int) -> None:
    """Refuse a reward that is not finite, and a state with something that is not a number."""
    if not np.isfinite(reward):
        raise ValueError(f"{game.id}: step {step} gives the reward {float(reward)}")
    for name, leaf in leaves(state, "state").items():
        if jnp.issubdtype(leaf.dtype, jnp.floating) and np.isnan(leaf).any():
            raise ValueError(f"{game.id}: step {step} gives state entry {name} as nan")


def check_made(game: Any, full_id: str, obs_size: int) -> None:
    """Refuse what a factory made if it is not the game that was asked for, or does not keep the
    contract.
    """
    if not isinstance(game, Game):
        raise ValueError(f"the factory of {full_id} made {kind_of(game)}, wanted a Game")
    id = getattr(game, "id", None)
    size = getattr(game, "obs_size", None)
    if (id, size) != (full_id, obs_size):
        arrived = f"{id!r} with obs_size {size!r}"
        raise ValueError(
            f"the factory of {full_id} made {arrived}, wanted {full_id!r} with obs_size "
            f"{obs_size}: pass on both"
        )
    check_foreign(game)


def check_foreign(game: Game[Any]) -> None:
    """``check_game`` for a game that is not one of this package, whose own are checked by its
    tests.
    """
    if not type(game).__module__.startswith(_OURS):
        check_game(game)


def _check_attributes(game: Game[Any]) -> None:
    """Refuse a game that lacks what describes it."""
    name = getattr(game, "id", None)
    if not isinstance(name, str):
        raise ValueError(
            f"{type(game).__name__}: id is {name!r}, wanted the versioned id, such as 'MineEasy-v0'"
        )
    for attribute in ("obs_size", "max_steps"):
        value = getattr(game, attribute, None)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name}: {attribute} is {value!r}, wanted an int of 1 or more")
    limits: Any = getattr(game, "return_range", None)
    is_pair = isinstance(limits, tuple) and len(limits) == 2
    is_range = is_pair and all(isinstance(limit, int | float) for limit in limits)
    if not is_range or not limits[0] <= limits[1]:
        raise ValueError(f"{name}: return_range is {limits!r}, wanted (lowest, highest)")
    if game.num_actions != NUM_ACTIONS:
        raise ValueError(
            f"{name}: num_actions is {game.num_actions!r}, wanted {NUM_ACTIONS}, the same in every "
            "game"
        )
    if game.memory_kind not in ("", *MEMORY_KINDS):
        raise ValueError(
            f"{name}: memory_kind is {game.memory_kind!r}, wanted {', '.join(MEMORY_KINDS)}, or "
            "nothing"
        )
    oracles: Any = game.oracles
    players = oracles.items() if isinstance(oracles, Mapping) else [("", None)]
    if not all(kind in ORACLES and callable(player) for kind, player in players):
        raise ValueError(
            f"{name}: oracles is {oracles!r}, wanted a dictionary with players under "
            f"{' or '.join(map(repr, ORACLES))}"
        )
