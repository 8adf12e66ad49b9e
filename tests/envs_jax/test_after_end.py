"""After an end nothing changes: state, frame and flags stay, the reward is 0, in every game and on
every way.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import BatchedGame, MixedGames, env_keys, gymnax, make
from arcade_torch.envs_jax.game import UNSET

from ..arcade_torch.stub import CoinGame, StubGame
from ..few import few, few_games
from ..test_own_game import Toy
from .conftest import ALL_IDS

ENVS, STEPS = 8, 320  # in so many random steps every Easy game ends somewhere
EASY = [*(id for id in ALL_IDS if "Easy" in id), "SignpostEasy-v0"]


def play(begin, advance):
    """Random steps in one compiled call: all states, and what each step gave."""

    @jax.jit
    def run():
        first = begin(env_keys(0, ENVS))
        keys = jax.random.split(jax.random.PRNGKey(1), STEPS)

        def step(state, key):
            action = jax.random.randint(key, (ENVS,), 0, 5)
            keys = jax.random.split(key, ENVS)
            state, outcome = advance(keys, state, action)
            return state, (state, outcome)

        return jax.lax.scan(step, first, keys)[1]

    return jax.tree.map(np.asarray, run())


def assert_stays(states, reward, terminated, truncated):
    """Leaves [STEPS, ENVS, ...]: from the first end of each env on, all is as at that end, and
    nothing is paid.
    """
    done = terminated | truncated
    assert done.any()
    late = 0
    for env in np.flatnonzero(done.any(0)):
        end = int(done[:, env].argmax())
        late += STEPS - 1 - end
        for leaf in [*jax.tree.leaves(states), terminated, truncated]:
            assert (leaf[end:, env] == leaf[end, env]).all()
        assert not reward[end + 1 :, env].any()
    assert late > 20, "hardly any step was taken after an end"


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("id", few_games(EASY))
def test_a_state_stays_in_pure_jax(id, rules):
    game = make(id, rules=rules)

    def advance(keys, state, action):
        state, *outcome = jax.vmap(game.step)(keys, state, action)
        return state, outcome

    states, (reward, terminated, truncated) = play(jax.vmap(game.reset), advance)
    assert_stays(states, reward, terminated, truncated)
    assert np.array_equal(states.terminated, terminated) and np.array_equal(
        states.truncated, truncated
    )


class SmallState(NamedTuple):
    """A state that keeps ends."""

    count: jax.Array
    terminated: jax.Array = UNSET
    truncated: jax.Array = UNSET


class Small(Toy):
    """A game of one's own whose state keeps ends, with small pictures."""

    def reset(self, key):
        return SmallState(jax.random.randint(key, (), 0, 3))

    def step(self, key, state, action):
        count = state.count + 1
        return SmallState(count), jnp.float32(1), count > 30, jnp.bool_(False)


def test_a_state_of_ones_own_with_flags_stays_in_pure_jax():
    game = Small(id="SmallEasy-v0", obs_size=8, rules="default")
    state = game.reset(jax.random.PRNGKey(0))._replace(count=jnp.int32(30))
    state, reward, terminated, _ = game.step(jax.random.PRNGKey(1), state, 0)
    assert bool(terminated) and reward == 1
    state, reward, terminated, _ = game.step(jax.random.PRNGKey(1), state, 0)
    assert bool(terminated) and reward == 0 and state.count == 31


BATCHES = {
    "a game": lambda: BatchedGame(make("SkittlesEasy")),
    "one's own": lambda: BatchedGame(StubGame()),
    "games": lambda: MixedGames([StubGame(), CoinGame()]),
    "both": lambda: MixedGames([Small(id="SmallEasy-v0", obs_size=8, rules="default"), CoinGame()]),
}


@pytest.mark.parametrize("which", few(BATCHES, often=["both"]))
def test_rows_of_a_batch_stay_and_begin_anew_when_reset(which):
    batched = BATCHES[which]()
    no = jnp.zeros(ENVS, bool)

    def advance(keys, batch, action):
        batch, outcome, frames = batched.step_render(batch, action)
        return batch, (outcome, frames.sum((1, 2, 3), dtype=jnp.int32))

    batches, (outcome, frames) = play(functools.partial(batched.init, partial=no), advance)
    state = batched.states(batches.state)[0]
    rows = batched.rows(ENVS)[0]
    part = lambda leaf: leaf[:, rows]  # noqa: E731
    counts = (batches.step_count, batches.episode_reward, batches.key, frames)
    assert_stays(
        (state, *map(part, counts)),
        part(outcome.reward),
        part(outcome.terminated),
        part(outcome.truncated),
    )

    last = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), batches)
    mask = np.arange(ENVS) % 2 == 0
    fresh = batched.reset_where(last, mask)
    assert not np.asarray(fresh.step_count)[mask].any()
    following, again = batched.step(fresh, jnp.zeros(ENVS, jnp.int32))
    assert (np.asarray(following.step_count)[mask] == 1).all()
    assert np.array_equal(again.done[~mask], outcome.done[-1][~mask])
    assert np.asarray(fresh.last_action)[~mask].any()
    assert not np.asarray(following.last_action).any()


@pytest.mark.parametrize("which", few(BATCHES, often=["both"]))
def test_a_batch_that_says_that_every_episode_runs_steps_to_the_same_bits(which):
    """A batch without flags has nothing to hold; the bridge carries such batches."""
    batched = BATCHES[which]()
    flagged = batched.init(env_keys(3, 6), np.zeros(6, bool))
    running = batched.without_ends(flagged)
    assert len(jax.tree.leaves(running)) < len(jax.tree.leaves(flagged))
    for number in range(40):
        action = np.full(6, number % 5, np.int32)
        flagged, _, outcome, frames = batched.step_autoreset(flagged, action)
        running, _, running_outcome, running_frames = batched.step_autoreset(running, action)
        pairs = zip(
            jax.tree.leaves((flagged, outcome, frames)),
            jax.tree.leaves((running, running_outcome, running_frames)),
            strict=True,
        )
        for one, other in pairs:
            assert np.array_equal(one, other)
        running = batched.without_ends(running)


@pytest.mark.parametrize("which", BATCHES)
def test_flags_can_be_taken_from_a_batch_and_put_back(which):
    batched = BATCHES[which]()
    batch = batched.init(env_keys(3, 6), np.zeros(6, bool))
    terminated = np.arange(6) % 2 == 0
    truncated = np.arange(6) > 3
    ended = batched.with_ends(batched.without_ends(batch), terminated, truncated)
    assert np.array_equal(batched.ends(ended), (terminated, truncated))
    assert jax.tree.structure(ended) == jax.tree.structure(batch)
    stepped, outcome = batched.step(ended, np.zeros(6, np.int32))
    held = terminated | truncated
    assert (np.asarray(outcome.done)[held]).all() and not np.asarray(outcome.reward)[held].any()
    assert (np.asarray(stepped.step_count) == ~held).all()


def test_step_env_of_the_adapter_stays_and_step_begins_anew():
    env, params = gymnax.make("MineSweeperEasy")
    obs, state = env.reset(jax.random.PRNGKey(0), params)
    step_env, step = jax.jit(env.step_env), jax.jit(env.step)
    for number in range(40):
        obs, state, reward, done, info = step_env(
            jax.random.PRNGKey(number), state, jnp.int32(number % 4), params
        )
    assert bool(done) and bool(info["truncated"])
    again, same, reward, done, _ = step_env(jax.random.PRNGKey(99), state, jnp.int32(4), params)
    assert np.array_equal(again, obs) and reward == 0 and bool(done)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(state), strict=True)
    )
    _, fresh, _, done, _ = step(jax.random.PRNGKey(99), state, jnp.int32(4), params)
    assert bool(done) and not bool(fresh.truncated) and fresh.timestep == 0


def test_a_batch_without_flags_has_not_ended():
    """Batches and states that were put together by hand may leave them out."""
    batched = BatchedGame(make("SkittlesEasy"))
    whole = batched.init(env_keys(0, 2), jnp.zeros(2, bool))
    state = whole.state._replace(terminated=None, truncated=None)
    bare = whole._replace(terminated=None, truncated=None, state=state)
    one, two = (batched.step(batch, jnp.zeros(2, jnp.int32))[0] for batch in (whole, bare))
    assert all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    )


@pytest.mark.parametrize("id", few_games(EASY))
def test_an_eager_state_can_be_donated(id):
    game = make(id)
    state = game.reset(jax.random.PRNGKey(0))
    pointers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(state)]
    assert len(set(pointers)) == len(pointers)
    stepped = game.step(jax.random.PRNGKey(1), state, 1)[0]
    pointers += [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(stepped)]
    assert len(set(pointers)) == len(pointers)
    many = jax.vmap(game.reset)(env_keys(0, 3))
    pointers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(many)]
    assert len(set(pointers)) == len(pointers)
    jax.jit(game.step, donate_argnums=1)(jax.random.PRNGKey(1), state, jnp.int32(1))


@pytest.mark.parametrize("which", few(BATCHES, often=["both"]))
def test_a_batch_can_be_donated(which):
    batched = BATCHES[which]()
    step = jax.jit(lambda batch: batched.step(batch, batch.last_action)[0], donate_argnums=0)
    partial = jnp.zeros(ENVS, bool)
    batch = step(batched.init(env_keys(0, ENVS), partial))
    batch = step(batched.reset_where(batch, np.arange(ENVS) < 2))
    assert not partial.any(), "what the caller gave is still there"
    assert np.asarray(batch.step_count).tolist()[:2] == [1, 1]
