"""Helpers shared by the tests of the games."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import BatchedGame, env_keys, make, registered_ids

ALL_IDS = registered_ids()


def pytest_collection_modifyitems(items):
    """What is tested at Easy too is slow at Hard, and what is tested at Medium is slow there:
    difficulties differ by numbers, not by code.
    """
    folder = Path(__file__).parent
    of_games = [item for item in items if folder in item.path.parents]
    ids = {item.nodeid for item in of_games}
    for item in of_games:
        easier = item.nodeid.replace("Hard", "Easy")
        if "Medium" in item.name or (easier != item.nodeid and easier in ids):
            item.add_marker(pytest.mark.slow)


@functools.cache
def batched(id, **options):
    """One compiled game for all tests that need it."""
    return BatchedGame(make(id, **options))


def going_on(batch):
    """The batch with no episode ended: what the rules do beyond an end, where an episode stays."""
    no = jnp.zeros(len(batch.step_count), bool)
    return batch._replace(state=batch.state._replace(terminated=no, truncated=no))


class Walk:
    """A rollout without resets, and beyond ends: states and outcomes of N envs over T steps, numpy
    [T, N, ...].
    """

    def __init__(self, game, actions, seed=0):
        envs = actions.shape[1]
        compiled = batched(game.id, rules=game.rules)
        batch = compiled.init(env_keys(seed, envs), jnp.zeros(envs, bool))
        states, outcomes = [batch.state], []
        for action in actions:
            batch, outcome = compiled.step(going_on(batch), action.astype(np.int32))
            states.append(batch.state)
            outcomes.append(outcome)
        self.states = jax.tree.map(
            lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *states
        )
        self.outcomes = jax.tree.map(
            lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *outcomes
        )
        self.last = batch


def random_actions(steps, envs, seed=0):
    """Uniformly random actions, int32 [steps, envs]."""
    return np.random.default_rng(seed).integers(0, 5, (steps, envs), dtype=np.int32)


def one(game, **changes):
    """A state of the game (from key 0) with some of its variables replaced."""
    state = game.reset(jax.random.PRNGKey(0))
    return state._replace(
        **{name: jnp.asarray(value, getattr(state, name).dtype) for name, value in changes.items()}
    )


_steps = {}


def step(game, state, action):
    """One step with key 0, compiled once a game: state, reward, terminated, truncated."""
    key = repr(game)
    if key not in _steps:
        _steps[key] = jax.jit(game.step)
    new, reward, terminated, truncated = _steps[key](jax.random.PRNGKey(0), state, np.int32(action))
    return new, float(reward), bool(terminated), bool(truncated)


@functools.cache
def fresh(id, rules="default", count=4096):
    """First states of many envs, with numpy leaves."""
    reset = jax.jit(jax.vmap(make(id, rules=rules).reset))
    return jax.tree.map(np.asarray, reset(env_keys(0, count)))


_compiled = {}


def draw(game, state, partial):
    """The frame of one state as a numpy array, by a renderer compiled once a game."""
    key = repr(game)
    if key not in _compiled:
        _compiled[key] = jax.jit(game.render)
    return np.asarray(_compiled[key](state, partial))


__all__ = [
    "ALL_IDS", "Walk", "batched", "draw", "fresh", "going_on", "make", "one", "random_actions", "step",
]  # fmt: skip
