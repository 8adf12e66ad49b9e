"""Laws of batching that hold for every game."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from arcade_torch.envs_jax import env_keys, make
from arcade_torch.envs_jax.oracles import RandomPlayer, play

from ..few import GAMES, few_games
from .conftest import ALL_IDS, batched, random_actions

ENVS = 64  # one batch size for most laws: each is a compilation of many seconds

FAMILIES = ["CartPoleEasy", "NoisyCartPoleHard", "MineSweeperEasy"]
EVERY_GAME = FAMILIES + [
    f"{game}Easy"
    for game in (
        "AutoEncode",
        "BattleShip",
        "Breakout",
        "CountRecall",
        "Navigator",
        "Skittles",
        "Tetris",
    )
]


def same(a, b):
    """Whether two pytrees agree bit for bit."""
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def rows(tree, index):
    """Rows of every leaf."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)


@pytest.mark.parametrize("id", few_games(EVERY_GAME))
def test_env_i_of_many_walks_the_path_it_walks_alone(id):
    game, index = batched(id), 39
    many = game.init(env_keys(5, ENVS), jnp.zeros(ENVS, bool))
    alone = game.init(env_keys(5, 1, first=index), jnp.zeros(1, bool))
    for action in random_actions(40, ENVS, seed=1):
        many, _, outcome, frames = game.step_autoreset(many, action)
        alone, _, outcome_alone, frames_alone = game.step_autoreset(
            alone, action[index : index + 1]
        )
        assert same(rows(many, [index]), alone)
        assert same(rows(outcome, [index]), outcome_alone)
        assert np.array_equal(np.asarray(frames)[index], np.asarray(frames_alone)[0])


@pytest.mark.parametrize("id", few_games(FAMILIES))
def test_the_fused_step_equals_step_then_reset(id):
    game = batched(id)
    fused = apart = game.init(env_keys(0, ENVS), jnp.arange(ENVS) % 2 == 0)
    ends = 0
    for action in random_actions(60, ENVS):
        fused, stepped, outcome, frames = game.step_autoreset(fused, action)
        before, outcome_apart, final_frames = game.step_render(apart, action)
        apart, root_frames = game.reset_render(before, outcome_apart.done)
        ends += int(outcome.done.sum())
        assert same(fused, apart) and same(stepped, before) and same(outcome, outcome_apart)
        assert np.array_equal(frames, root_frames)
        assert np.array_equal(game.render(stepped), final_frames)
    assert ends > 10


@pytest.mark.parametrize("id", few_games(FAMILIES))
@settings(max_examples=15, deadline=None)
@given(mask=hnp.arrays(bool, ENVS), steps=st.integers(0, 6), seed=st.integers(0, 2**32 - 1))
def test_a_masked_reset_leaves_the_others_untouched(id, mask, steps, seed):
    game = batched(id)
    batch = game.init(env_keys(seed, ENVS), jnp.zeros(ENVS, bool))
    for action in random_actions(steps, ENVS, seed=seed):
        batch, _ = game.step(batch, action)
    after = game.reset_where(batch, mask)
    assert same(rows(after, ~mask), rows(batch, ~mask))
    assert (np.asarray(after.step_count)[mask] == 0).all() and (
        np.asarray(after.episode_reward)[mask] == 0
    ).all()
    assert np.array_equal(after.last_action, batch.last_action)
    assert (np.asarray(after.key)[mask] != np.asarray(batch.key)[mask]).any(axis=-1).all()


TWINS = []
for _id in EVERY_GAME:
    _often = [] if _id.startswith(GAMES) else [pytest.mark.slow]
    TWINS.append(pytest.param(_id, "default", marks=_often))
    TWINS.append(pytest.param(_id.replace("Easy", "Hard"), "reference", marks=pytest.mark.slow))


@pytest.mark.parametrize(("id", "rules"), TWINS)
def test_twins_step_in_lockstep(id, rules):
    game = batched(id, rules=rules)
    full, partial = (game.init(env_keys(2, ENVS), jnp.full(ENVS, flag)) for flag in (False, True))
    hidden = 0
    for action in random_actions(50, ENVS):
        full, _, outcome, frames = game.step_autoreset(full, action)
        partial, _, outcome_partial, frames_partial = game.step_autoreset(partial, action)
        assert same(full._replace(partial=partial.partial), partial) and same(
            outcome, outcome_partial
        )
        hidden += not np.array_equal(frames, frames_partial)
        differ = (np.asarray(frames) != np.asarray(frames_partial)).any((0, 2, 3))
        assert not differ[:14].any() and not differ[115:].any(), (
            "number and name are the same in both"
        )
    assert hidden > 25, "the twins ought to look different"


@pytest.mark.parametrize("id", few_games(EVERY_GAME))
def test_the_frame_is_a_function_of_state_and_twin_alone(id):
    game = batched(id)
    batch = game.init(env_keys(3, ENVS), jnp.arange(ENVS) % 3 == 0)
    for action in random_actions(12, ENVS):
        batch, _, _, frames = game.step_autoreset(batch, action)
        assert np.array_equal(frames, game.render(batch))
        switched = batch._replace(partial=~np.asarray(batch.partial))
        again = switched._replace(
            partial=~np.asarray(switched.partial),
            key=batch.key * 0,
            last_action=batch.last_action * 0,
        )
        assert np.array_equal(game.render(again), frames)


# Every game at its easiest; the rest is slow.
LONG_ROLLOUTS = []
for _id in ALL_IDS:
    _often = [] if "Easy" in _id else [pytest.mark.slow]
    LONG_ROLLOUTS.append(pytest.param(_id, "default", marks=_often))
    LONG_ROLLOUTS.append(pytest.param(_id, "reference", marks=pytest.mark.slow))


@pytest.mark.parametrize(("id", "rules"), LONG_ROLLOUTS)
def test_long_random_rollouts_keep_the_contract(id, rules):
    game = batched(id, rules=rules)
    low, high = game.game.return_range
    batch = game.init(env_keys(7, ENVS), jnp.arange(ENVS) % 2 == 0)
    returns, longest = [], 0
    for action in random_actions(150, ENVS, seed=3):
        batch, stepped, outcome, frames = game.step_autoreset(batch, action)
        done = np.asarray(outcome.done)
        assert np.array_equal(done, np.asarray(outcome.terminated) | np.asarray(outcome.truncated))
        assert outcome.reward.dtype == np.float32 and np.isfinite(outcome.reward).all()
        returns.extend(np.asarray(stepped.episode_reward)[done])
        longest = max(longest, int(np.asarray(stepped.step_count).max()))
    assert frames.dtype == np.uint8 and frames.shape == (ENVS, 128, 128, 3)
    assert all(len(np.unique(frame)) > 2 for frame in np.asarray(frames)), "a blank frame"
    if game.game.max_steps < 130:
        assert len(returns) >= ENVS, "every env ought to have finished an episode"
    assert all(low - 1e-5 <= value <= high + 1e-5 for value in returns)
    assert longest <= game.game.max_steps + (rules == "reference")


@pytest.mark.parametrize("id", few_games(EVERY_GAME))
@settings(max_examples=4, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    small=st.booleans(),
    actions=hnp.arrays(np.int32, (10, ENVS), elements=st.integers(0, 4)),
    partial=hnp.arrays(bool, ENVS),
)
def test_any_play_from_any_seed_keeps_the_contract(id, seed, small, actions, partial):
    """Ends are one of two kinds, returns stay in the documented range, no frame is blank, nothing
    is not a number.
    """
    game = batched(id)
    size = 1 if small and id in FAMILIES else ENVS  # each size is a compilation more
    low, high = game.game.return_range
    batch = game.init(env_keys(seed, size), jnp.asarray(partial[:size]))
    for action in actions[:, :size]:
        batch, stepped, outcome, frames = game.step_autoreset(batch, action)
        done, frames = np.asarray(outcome.done), np.asarray(frames)
        assert np.array_equal(done, np.asarray(outcome.terminated) | np.asarray(outcome.truncated))
        assert outcome.reward.dtype == np.float32 and outcome.reward.shape == (size,)
        returns = np.asarray(stepped.episode_reward)[done]
        assert ((returns >= low - 1e-5) & (returns <= high + 1e-5)).all()
        assert frames.dtype == np.uint8 and frames.shape == (size, 128, 128, 3)
        assert (
            (frames.reshape(size, -1, 3).max(1) > frames.reshape(size, -1, 3).min(1)).any(1).all()
        ), "a blank frame"
        floats = [
            leaf for leaf in jax.tree.leaves((stepped, batch, outcome)) if leaf.dtype == np.float32
        ]
        assert all(np.isfinite(leaf).all() for leaf in floats)


LIMIT_NAMES = ("time", "timestep", "moves")  # what the games call the steps taken


@pytest.mark.parametrize("id", few_games(EVERY_GAME))
def test_a_new_episode_is_what_reset_gives_for_the_key_of_its_env(id):
    """After an end the state and the frame are those of `reset` with the derived key; other envs
    just go on.
    """
    game = batched(id)
    batch = game.init(env_keys(4, ENVS), jnp.arange(ENVS) % 2 == 0)
    for action in random_actions(3, ENVS, seed=2):
        batch, *_ = game.step_autoreset(batch, action)
    clock = next(name for name in LIMIT_NAMES if hasattr(batch.state, name))
    at_limit = np.arange(ENVS) % 3 == 0
    time = jnp.where(at_limit, game.game.max_steps - 1, getattr(batch.state, clock))
    batch = batch._replace(
        state=batch.state._replace(**{clock: time.astype(getattr(batch.state, clock).dtype)})
    )
    root, stepped, outcome, frames = game.step_autoreset(batch, np.zeros(ENVS, np.int32))
    done = np.asarray(outcome.done)
    assert (done >= at_limit).all() and not done.all()
    keep, use = jax.vmap(jax.random.split, out_axes=1)(stepped.key)
    fresh = jax.jit(jax.vmap(game.game.reset))(use)
    assert same(rows(root.state, done), rows(fresh, done)) and same(
        rows(root.state, ~done), rows(stepped.state, ~done)
    )
    assert np.array_equal(np.asarray(root.key)[done], np.asarray(keep)[done])
    drawn = game.render(batch._replace(state=fresh))
    assert np.array_equal(np.asarray(frames)[done], np.asarray(drawn)[done])


@pytest.mark.slow
@pytest.mark.parametrize("id", ALL_IDS)
def test_ten_thousand_random_episodes_return_what_the_table_allows(id):
    game = make(id)
    low, high = game.return_range
    episodes = play(game, RandomPlayer(1), 10_000, seed=9, block=2048)
    assert (episodes.returns >= low - 1e-5).all() and (episodes.returns <= high + 1e-5).all()
    assert (episodes.lengths >= 1).all() and (episodes.lengths <= game.max_steps).all()


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    actions=hnp.arrays(np.int32, (20, ENVS), elements=st.integers(0, 4)),
)
def test_equal_seeds_and_actions_give_equal_bits(seed, actions):
    game = batched("MineSweeperEasy")

    def play():
        batch = game.init(env_keys(seed, ENVS), jnp.zeros(ENVS, bool))
        for action in actions:
            batch, _, _, frames = game.step_autoreset(batch, action)
        return batch, frames

    assert same(play(), play())


def test_a_seed_out_of_range_is_refused():
    for seed in (-1, 2**32):
        with pytest.raises(ValueError, match="seed is"):
            env_keys(seed, 2)


def test_keys_depend_on_seed_and_index_alone():
    assert np.array_equal(env_keys(9, 512)[100:103], env_keys(9, 3, first=100))
    assert len(np.unique(np.asarray(env_keys(9, 512)), axis=0)) == 512
