"""gymnax's signatures: the game's own steps, a new episode at every end, twins by parameter."""

import inspect
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import gymnax
from arcade_torch.envs_jax.batch import choose_rows
from arcade_torch.envs_jax.gymnax import GymnaxEnv

KEY = jax.random.PRNGKey(0)


def equal(one, two):
    return all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    )


@pytest.fixture(scope="module")
def walk():
    """300 random steps of four envs in one scan: keys, states before, actions, what step gave;
    leaves [1200, ...].
    """
    env, params = gymnax.make("MineSweeperEasy")

    def step(state, key):
        to_act, to_step = jax.random.split(key)
        keys, action = jax.random.split(to_step, 4), jax.random.randint(to_act, (4,), 0, 5)
        given = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, state, action, params)
        return given[1], (keys, state, action, given)

    _, begin = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(KEY, 4), params)
    steps = jax.jit(lambda: jax.lax.scan(step, begin, jax.random.split(KEY, 300))[1])()
    return env, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), steps)


def test_steps_are_the_games_own_and_an_end_is_followed_by_a_reset(walk):
    env, (keys, state, action, (obs, following, reward, done, info)) = walk
    again, stepped, outcome = jax.jit(jax.vmap(env.game.step_autoreset))(keys, state, action)
    halves = jax.vmap(jax.random.split)(keys)
    expected = jax.vmap(env.game.step)(halves[:, 0], state, action)
    begun = jax.vmap(env.game.reset)(halves[:, 1])
    assert equal(again, following) and equal((stepped, *outcome), expected)
    assert equal(following, choose_rows(done, begun, stepped))
    terminated, truncated = info["terminated"], info["truncated"]
    assert equal((reward, terminated, truncated), outcome) and equal(done, terminated | truncated)
    assert equal(info["discount"], 1.0 - terminated)
    assert terminated.any() and (truncated & ~terminated).any()
    some = slice(None, None, 50)
    drawn = jax.vmap(partial(env.game.render, partial=False))(
        jax.tree.map(lambda leaf: leaf[some], following)
    )
    assert equal(obs[some], drawn)


def test_step_env_shows_the_final_observation(walk):
    env, (keys, state, action, (obs, _, reward, done, _)) = walk
    end = int(np.flatnonzero(done)[0])
    before = jax.tree.map(lambda leaf: leaf[end], state)
    final, after, paid, ended, _ = env.step_env(jax.random.split(keys[end])[0], before, action[end])
    assert bool(ended) and paid == reward[end]
    assert equal(final, env.game.render(after, False)) and not equal(final, obs[end])


def test_the_twin_is_a_parameter_traced_or_static():
    env, params = gymnax.make("NavigatorEasy", observability="partial")
    assert params == (True, 64) and env.default_params.max_steps_in_episode == env.game.max_steps
    _, state = env.reset(KEY, params)
    _, state, *_ = env.step(KEY, state, 0, params)
    both = jax.jit(jax.vmap(lambda hides: env.get_obs(state, params._replace(partial=hides))))(
        jnp.array([False, True])
    )
    static = jax.jit(env.get_obs, static_argnums=1)
    for hides in (False, True):
        assert equal(both[int(hides)], env.game.render(state, hides))
        assert equal(both[int(hides)], static(state, params._replace(partial=hides)))
    assert equal(both[1], env.get_obs(state)) and not equal(both[0], both[1])


def test_spaces_hold_what_is_given_and_taken_and_nothing_else():
    env, params = gymnax.make("CartPoleEasy", obs_size=256)
    seen, actions = env.observation_space(params), env.action_space(params)
    obs, _ = env.reset(KEY, params)
    assert (obs.shape, obs.dtype) == (seen.shape, seen.dtype) == ((256, 256, 3), jnp.uint8)
    sample = seen.sample(KEY)
    assert (
        (sample.shape, sample.dtype) == (seen.shape, seen.dtype)
        and sample.max() == 255
        and sample.min() == 0
    )
    assert seen.contains(obs) and not seen.contains(obs.astype(jnp.int32) - 1)
    drawn = jax.vmap(actions.sample)(jax.random.split(KEY, 64))
    assert (
        set(drawn.tolist()) == set(range(env.num_actions))
        and jax.vmap(actions.contains)(drawn).all()
    )
    assert not actions.contains(5) and not actions.contains(-1)
    assert env.name == "CartPoleEasy-v0"


def test_the_signatures_are_gymnaxs():
    for method, names in (
        ("reset", "self key params"),
        ("step", "self key state action params"),
        ("step_env", "self key state action params"),
        ("action_space", "self params"),
        ("observation_space", "self params"),
    ):
        assert list(inspect.signature(getattr(GymnaxEnv, method)).parameters) == names.split()


def test_bad_arguments_are_refused_in_one_line():
    with pytest.raises(ValueError, match="observability is 'half', allowed: 'full', 'partial'"):
        gymnax.make("CartPoleEasy", "half")
    with pytest.raises(TypeError, match="has no option 'arow'"):
        gymnax.make("CartPoleEasy", arow="log")


def test_params_are_replaced_as_gymnax_does_and_refuse_what_would_do_nothing():
    env, params = gymnax.make("MineSweeperEasy")
    _, state = env.reset(KEY, params)
    hidden = params.replace(partial=True)
    assert hidden.partial is True and params.partial is False
    assert np.array_equal(env.get_obs(state, hidden), env.game.render(state, True))
    assert params.replace(max_steps_in_episode=32) == params == params.replace()
    both = jax.vmap(lambda partial: env.get_obs(state, params.replace(partial=partial)))(
        jnp.array([False, True])
    )
    assert np.array_equal(both[1], env.game.render(state, True))
    with pytest.raises(
        TypeError, match="params have no 'max_steps', allowed: partial, max_steps_in_episode"
    ):
        params.replace(max_steps=3)
    with pytest.raises(ValueError, match="max_steps_in_episode is 10, allowed: 32") as refused:
        params.replace(max_steps_in_episode=10)
    assert "\n" not in str(refused.value)
