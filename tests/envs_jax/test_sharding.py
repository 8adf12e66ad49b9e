"""Games in functions that ``shard_map`` lays out over devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

from arcade_torch.envs_jax import BatchedGame, MixedGames, env_keys, gymnax, make

from ..arcade_torch.stub import StubGame
from .conftest import ALL_IDS

SPLIT = PartitionSpec("devices")
ENVS = 4
ACTIONS = np.arange(3 * ENVS, dtype=np.int32).reshape(3, ENVS) % 5


def walk_pure(game, keys, actions):
    """``scan`` over steps of a vectorised game, with frames."""

    def advance(state, action):
        state, _, outcome = jax.vmap(game.step_autoreset)(keys, state, action)
        return state, (outcome, jax.vmap(game.render, in_axes=(0, None))(state, True))

    return jax.lax.scan(advance, jax.vmap(game.reset)(keys), actions)


def walk_batched(game, keys, actions):
    """The same by the functions of a batch."""
    batched = game if isinstance(game, BatchedGame) else BatchedGame(game)

    def advance(batch, action):
        batch, outcome = batched.step(batch, action)
        batch = batched.reset_where(batch, outcome.done)
        return batch, (outcome, batched.render(batch))

    return jax.lax.scan(advance, batched.init(keys, jnp.zeros(len(keys), bool)), actions)


def walk_gymnax(game, keys, actions):
    """The same by gymnax's signatures."""
    env = gymnax.GymnaxEnv(game)
    params = env.default_params
    step = jax.vmap(env.step, in_axes=(0, 0, 0, None))

    def advance(carry, action):
        obs, state, *outcome = step(keys, carry[1], action, params)
        return (obs, state), outcome

    return jax.lax.scan(advance, jax.vmap(env.reset, in_axes=(0, None))(keys, params), actions)


def walk_alone(game, keys, actions):
    """One env a device, its step or a new episode chosen by ``cond``."""

    def advance(state, action):
        return jax.lax.cond(
            action[0] == 4,
            lambda: game.reset(keys[0]),
            lambda: game.step(keys[0], state, action[0])[0],
        ), None

    state, _ = jax.lax.scan(advance, game.reset(keys[0]), actions)
    return jax.tree.map(lambda leaf: leaf[None], state), None


WALKS = [walk_pure, walk_batched, walk_gymnax, walk_alone]


def assert_equal(one, two):
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert left.dtype == right.dtype and np.array_equal(left, right)


def mapped(walk, game):
    mesh = jax.make_mesh((1,), ("devices",), axis_types=(AxisType.Auto,))
    split_in_time = PartitionSpec(None, "devices")
    return jax.jit(
        jax.shard_map(
            lambda *arguments: walk(game, *arguments),
            mesh=mesh,
            in_specs=(SPLIT, split_in_time),
            out_specs=(SPLIT, split_in_time),
        )
    )


@pytest.mark.parametrize("walk", WALKS)
def test_a_loop_of_a_game_runs_under_shard_map(walk):
    """Entries of a state that are the same in every episode have the type of the others."""
    game = StubGame()
    keys = env_keys(0, ENVS)
    alone = jax.jit(lambda *arguments: walk(game, *arguments))(keys, ACTIONS)
    assert_equal(mapped(walk, game)(keys, ACTIONS), alone)


@pytest.mark.parametrize("id", [id for id in ALL_IDS if "Easy" in id])
def test_a_loop_of_a_game_of_this_package_can_be_traced_under_shard_map(id):
    for walk in (walk_pure, walk_batched):
        mapped(walk, make(id)).trace(env_keys(0, ENVS), ACTIONS)


def test_a_loop_of_several_games_can_be_traced_under_shard_map():
    games = MixedGames([make("SkittlesEasy"), make("NavigatorEasy")])
    mapped(walk_batched, games).trace(env_keys(0, ENVS), ACTIONS)
