"""``from_jax`` on suites of others, each against a loop over the suite's own functions.

`make test-suites` and `make parity` install them; elsewhere tests of what is missing are skipped.
"""

import importlib
import os
from typing import Any

import jax
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from arcade_torch import from_jax
from arcade_torch.envs_jax.batch import env_keys

# (module, what makes an env and its params, options of from_jax)
CASES = {
    "gymnax CartPole": ("gymnax", "CartPole-v1", {}),
    "gymnax Pendulum": ("gymnax", "Pendulum-v1", {}),
    "gymnax MinAtar Breakout": ("gymnax", "Breakout-MinAtar", {}),
    "gymnax MemoryChain": ("gymnax", "MemoryChain-bsuite", {}),
    "popgym_arcade CartPole": ("popgym_arcade", "CartPoleEasy", {"max_steps": 200}),
    "popgym_arcade MineSweeper": ("popgym_arcade", "MineSweeperEasy", {}),
    "craftax": ("craftax", "Craftax-Classic-Symbolic-v1", {}),
}
cases = pytest.mark.parametrize("name", CASES)


def suite(name: str) -> tuple[Any, Any, dict[str, Any]]:
    """The env, its params and the options of a case."""
    module, id, options = CASES[name]
    module = "craftax.craftax_env" if module == "craftax" else module
    is_required = "SUITES_ARE_THERE" in os.environ
    package = importlib.import_module(module) if is_required else pytest.importorskip(module)
    if module == "craftax.craftax_env":
        env = package.make_craftax_env_from_name(id, auto_reset=True)
        return env, env.default_params, options
    env, params = package.make(id)
    return env, params, options


def same(ours: torch.Tensor, theirs: Any) -> None:
    """Whether two results are the same, floats to seven digits."""
    theirs = np.asarray(theirs)
    if np.issubdtype(theirs.dtype, np.floating):
        np.testing.assert_allclose(ours.numpy(), theirs, rtol=2e-6, atol=2e-6)
    else:
        np.testing.assert_array_equal(ours.numpy(), theirs)


@cases
def test_torchrl_s_checker_passes(name: str) -> None:
    env, params, options = suite(name)
    check_env_specs(from_jax(env, params, 2, **options), seed=0)


@cases
def test_it_is_the_suite_s_own_loop(name: str) -> None:
    """Automatic resets included; the last observation of an episode is the one before them.

    Whole numbers and flags are equal; floats to seven digits, for two programs that XLA compiles
    from one function may round differently.
    """
    env, params, options = suite(name)
    steps = 40 if name == "craftax" else 120
    ours = from_jax(env, params, 3, seed=5, **options)
    torch.manual_seed(0)
    data = ours.rollout(steps, break_when_any_done=False)
    key = ours._obs_names[0]
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    split = jax.vmap(jax.random.split)
    pairs = split(env_keys(5, 3))
    keys = pairs[:, 0]
    obs, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(pairs[:, 1], params)
    for time in range(steps):
        row = data[:, time]
        same(row[key], obs)
        pairs = split(keys)
        keys = pairs[:, 0]
        action = row["action"].numpy()
        if np.issubdtype(action.dtype, np.integer):
            action = action.astype(np.int32)
        obs, state, reward, *flags, _ = step(pairs[:, 1], state, action, params)
        done = np.logical_or.reduce(flags)
        same(row["next", "reward"].squeeze(-1), reward.astype(np.float32))
        assert np.array_equal(row["next", "done"].squeeze(-1), done), time
        going_on = ~done
        same(row["next", key][going_on], np.asarray(obs)[going_on])
