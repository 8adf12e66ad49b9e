"""Skittles, checked against a plain simulation of its grid, and its flicker against what the paper
says of it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from arcade_torch.envs_jax import env_keys, make
from arcade_torch.envs_jax.oracles import oracle_return, random_return
from arcade_torch.envs_jax.skittles.oracle import UNSEEN, Planner, outlook
from arcade_torch.envs_jax.skittles.renderer import AGENT
from arcade_torch.envs_jax.skittles.rules import NO_BLOCK, visible_rows

from .conftest import Walk, batched, draw, going_on, one, random_actions

LANES = {"SkittlesEasy": range(1, 9), "SkittlesMedium": range(2, 9), "SkittlesHard": range(2, 8)}
HARD = "SkittlesHard"
COMPILED = {}


def step_many(game, state, action, count, seed=0):
    """One state stepped with many random keys: numpy leaves [count, ...]."""
    key = (game.id, game.rules, game.hit_reward)
    if key not in COMPILED:
        COMPILED[key] = jax.jit(jax.vmap(game.step, in_axes=(0, None, None)))
    keys = env_keys(seed, count)
    return jax.tree.map(np.asarray, COMPILED[key](keys, state, jnp.int32(action)))


def step(game, state, action):
    """One step with some key: state, reward, terminated, truncated."""
    new, reward, terminated, truncated = step_many(game, state, action, 2)
    return (
        jax.tree.map(lambda leaf: leaf[0], new),
        float(reward[0]),
        bool(terminated[0]),
        bool(truncated[0]),
    )


def falling(game, blocks, **changes):
    """A state with blocks in the given rows: {row: column}."""
    column = np.full(10, NO_BLOCK)
    for row, where in blocks.items():
        column[row] = where
    return one(game, column=column, **changes)


@pytest.mark.parametrize("id", LANES)
def test_episodes_start_with_an_empty_grid_and_the_agent_anywhere_in_its_lane(id):
    lane = list(LANES[id])
    fresh = jax.tree.map(
        np.asarray, batched(id).init(env_keys(0, 4096), jnp.zeros(4096, bool)).state
    )
    assert (fresh.column == NO_BLOCK).all() and (fresh.colour == 0).all() and fresh.safe.all()
    count = np.bincount(fresh.x, minlength=10)
    assert count.sum() == count[lane].sum()
    rate = 1 / len(lane)
    assert (np.abs(count[lane] - 4096 * rate) < 4.5 * np.sqrt(4096 * rate * (1 - rate))).all()
    assert len(np.unique(fresh.flicker_key, axis=0)) == 4096


@settings(max_examples=8, deadline=None)
@given(
    game=st.sampled_from(
        [("SkittlesEasy", "default"), ("SkittlesMedium", "default"), (HARD, "reference")]
    ),
    seed=st.integers(0, 2**31),
    actions=hnp.arrays(np.int32, (20, 16), elements=st.integers(0, 4)),
)
def test_every_step_equals_a_simulation_on_the_full_grid(game, seed, actions):
    id, rules = game
    lane = list(LANES[id])
    walk = Walk(make(id, rules=rules), actions, seed)
    for env in range(16):
        grid, colours, x = np.zeros((10, 10), int), [0] * 10, int(walk.states.x[0, env])
        for t, action in enumerate(actions[:, env], start=1):
            x = min(max(x + {2: -1, 3: 1}.get(int(action), 0), lane[0]), lane[-1])
            hit = grid[9, x]
            block = int(walk.states.column[t, env, 0])
            assert block in lane
            grid = np.roll(grid, 1, axis=0)
            grid[0] = np.arange(10) == block
            colours = [(colours[0] + 1) % 7, *colours[:-1]]
            hit |= grid[9, x]
            ours = walk.states.column[t, env][:, None] == np.arange(10)
            assert np.array_equal(ours, grid) and walk.states.x[t, env] == x
            assert list(walk.states.colour[t, env]) == colours
            assert bool(walk.outcomes.terminated[t - 1, env]) is bool(hit)
            assert walk.outcomes.reward[t - 1, env] == np.float32(0.01)
            assert walk.states.time[t, env] == t


@pytest.mark.parametrize(
    ("blocks", "action", "hit"),
    [
        ({8: 5}, 0, True),  # falls on the agent
        ({8: 5}, 2, False),  # aside in time
        ({9: 4}, 2, True),  # walks into a block beside it
        ({9: 4}, 0, False),
        ({8: 4}, 2, True),  # walks under a falling one
        ({7: 5}, 0, False),
        ({9: 5}, 0, True),
    ],
)
def test_the_agent_is_hit_by_what_it_walks_into_and_by_what_falls_on_it(blocks, action, hit):
    game = make(HARD)
    _, reward, terminated, truncated = step(game, falling(game, blocks, x=5, time=50), action)
    assert (terminated, truncated) == (hit, False)
    assert reward == pytest.approx(0.01), "the fatal step pays as well"


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("hit", [False, True])
def test_the_time_limit_truncates_but_does_not_terminate(rules, hit):
    game = make(HARD, rules=rules)
    blocks = {8: 5} if hit else {}
    assert step(game, falling(game, blocks, x=5, time=99), 0)[2:] == (hit, True)
    assert step(game, falling(game, blocks, x=5, time=98), 0)[2:] == (hit, False)


def test_a_hit_can_be_made_to_cost_something():
    game = make(HARD, hit_reward=-0.5)
    assert step(game, falling(game, {8: 5}, x=5), 0)[1] == pytest.approx(-0.49)
    assert step(game, falling(game, {8: 5}, x=5), 2)[1] == pytest.approx(0.01)
    assert game.return_range == (pytest.approx(-0.4), 1.0)
    for value in (0.1, -2):
        with pytest.raises(ValueError, match="hit_reward"):
            make(HARD, hit_reward=value)


@pytest.mark.parametrize("id", ["SkittlesEasy", HARD])
def test_nobody_is_hit_before_step_ten_and_an_idle_agent_lives_as_long_as_chance_has_it(id):
    """The reference draws blocks independently: ten steps, then each hits with 1 / width."""
    width = len(LANES[id])
    lengths = np.minimum(9 + np.arange(1, 2000), 100)
    chance = (1 - 1 / width) ** np.arange(1999) / width
    mean = (lengths * chance).sum()
    deviation = np.sqrt((lengths**2 * chance).sum() - mean**2)
    for rules, slack in (("reference", 0.0), ("default", 0.3)):
        hit = Walk(make(id, rules=rules), np.zeros((100, 512), int), seed=3).outcomes.terminated
        length = np.where(hit.any(0), hit.argmax(0) + 1, 100)
        assert length.min() == 10
        assert abs(length.mean() - mean) < 4.5 * deviation / np.sqrt(512) + slack


def survivors(columns, lane):
    """Where somebody who starts anywhere in the lane can be after each row, by plain sets; columns:
    int [T].
    """
    alive, before, history = set(lane), None, []
    for block in columns:
        alive = {c for c in lane if {c - 1, c, c + 1} & alive} - {before, int(block)}
        before = int(block)
        history.append(alive)
    return history


@pytest.mark.parametrize("id", LANES)
def test_a_way_through_exists_in_every_episode(id):
    lane = list(LANES[id])
    states = Walk(make(id), random_actions(100, 512, seed=5), seed=5).states
    assert states.safe.any(-1).all()
    for env in range(40):
        for t, alive in enumerate(survivors(states.column[1:, env, 0], lane), start=1):
            assert set(np.flatnonzero(states.safe[t, env]) + lane[0]) == alive


def test_in_the_reference_some_episodes_have_no_way_through():
    states = Walk(make(HARD, rules="reference"), random_actions(100, 512, seed=5), seed=5).states
    dead = ~states.safe[-1].any(-1)
    assert 1 <= dead.sum() <= 20, "about 1.5 % are expected"
    env = int(dead.argmax())
    assert survivors(states.column[1:, env, 0], list(LANES[HARD]))[-1] == set()


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_a_block_that_would_close_the_last_way_is_not_drawn(rules):
    """Survivors are at the left edge, the newest block beside them: only a block on the edge would
    close the way.
    """
    game = make(HARD, rules=rules)
    state = falling(game, {0: 3}, safe=np.arange(6) == 0)
    count = np.bincount(step_many(game, state, 0, 2048)[0].column[:, 0], minlength=10)
    assert (count[2] == 0) == (rules == "default")
    drawn = count[3:8] if rules == "default" else count[2:8]
    rate = 1 / len(drawn)
    assert drawn.sum() == 2048
    assert (np.abs(drawn - 2048 * rate) < 4.5 * np.sqrt(2048 * rate * (1 - rate))).all()


def masks(rules, envs=512, steps=30):
    """Which blocks the POMDP shows in many episodes: bool [steps, envs, row], and the columns
    [steps, envs, row].
    """
    states = Walk(make(HARD, rules=rules), random_actions(steps, envs, seed=6), seed=6).states
    visible = np.asarray(jax.jit(jax.vmap(jax.vmap(visible_rows)))(states))
    return visible[1:], states.column[1:]


def test_half_of_all_blocks_are_shown_and_every_episode_flickers_in_its_own_way():
    visible, column = masks("default")
    block = column != NO_BLOCK
    looks = block.sum()
    assert abs(visible[block].mean() - 0.5) < 4.5 * 0.5 / np.sqrt(looks)
    each_row = np.array([visible[..., row][block[..., row]].mean() for row in range(10)])
    assert np.abs(each_row - 0.5).max() < 0.03
    later, earlier = visible[1:][block[1:]], visible[:-1][block[1:]]
    assert abs((later == earlier).mean() - 0.5) < 0.02, "times ought to be independent"
    assert abs((visible[:, 0] == visible[:, 1]).mean() - 0.5) < 0.2, (
        "episodes ought to be independent"
    )


def test_in_the_reference_a_cell_is_hidden_at_the_same_times_in_every_episode():
    visible, column = masks("reference")
    seen = {}
    for t, env, row in np.argwhere(column[:, :60] != NO_BLOCK):
        cell = (t, row, column[t, env, row])
        assert seen.setdefault(cell, visible[t, env, row]) == visible[t, env, row]
    assert 0.4 < np.mean(list(seen.values())) < 0.6


@pytest.mark.parametrize("size", [128, 256])
def test_blocks_colours_and_agent_can_be_read_back_from_both_twins(size):
    game, compiled = make(HARD, obs_size=size), batched(HARD, obs_size=size)
    batch = compiled.init(env_keys(4, 16), jnp.zeros(16, bool))
    for t, action in enumerate(random_actions(24, 16, seed=8)):
        if t in (0, 6, 23):
            state = jax.tree.map(np.asarray, batch.state)
            expected = np.where(
                state.column[..., None] == np.arange(10), 1 + state.colour[..., None], 0
            )
            visible = np.asarray(jax.vmap(visible_rows)(batch.state))[..., None]
            for partial, codes in ((False, expected), (True, expected * visible)):
                codes = codes.copy()
                codes[np.arange(16), 9, state.x] = AGENT
                frames = compiled.render(batch._replace(partial=jnp.full(16, partial)))
                assert np.array_equal(game.screen.board.read(np.asarray(frames), 10, 10), codes)
        batch, _ = compiled.step(going_on(batch), action)


def test_twins_are_equal_in_the_first_frame_and_differ_by_hidden_blocks_later():
    game = make(HARD)
    first = one(game)
    assert np.array_equal(draw(game, first, True), draw(game, first, False))
    later = falling(game, {row: 2 + row % 6 for row in range(10)}, x=5, time=30)
    full, partial = draw(game, later, False), draw(game, later, True)
    differ = (full != partial).any(-1)
    assert differ.any() and (partial[differ] == 0).all()


def test_every_visible_variable_changes_the_mdp_picture():
    game = make(HARD)
    base = falling(game, {4: 3}, x=4, time=7)
    frame = draw(game, base, False)
    for changes in (
        {"column": base.column.at[4].set(5)},
        {"colour": base.colour.at[4].set(3)},
        {"x": 5},
        {"time": 8},
    ):
        assert not np.array_equal(frame, draw(game, base._replace(**changes), False)), changes
    assert np.array_equal(frame, draw(game, base._replace(flicker_key=base.flicker_key + 1), False))


def test_the_outlook_of_a_set_is_the_chance_of_a_way_through():
    """One block ahead, by enumeration."""
    worth = outlook(6, rounds=1)
    assert worth.shape == (64, 7)
    assert worth[0].max() == 0 and worth[-1].min() == 1
    assert worth[0b000001, 1] == pytest.approx(5 / 6), (
        "only the edge is left, one block of six closes it"
    )
    assert worth[0b000001, 6] == 1


def test_the_planner_steps_out_of_the_way():
    planner = Planner(make(HARD).level)
    column = np.full((4, 10), NO_BLOCK)
    column[0, 8] = 5  # above the agent: step aside, either way
    column[1, 8:] = (5, 4)  # above, and one to the left: right
    column[2, 8:] = (5, 6)
    column[3, 9] = 4  # beside it: wait
    moves = planner.plan(np.full(4, 5), column)
    assert moves[0] in (2, 3) and list(moves[1:]) == [3, 2, 0]
    column[:, 0] = UNSEEN
    assert list(planner.plan(np.full(4, 5), column)[1:3]) == [3, 2]


@pytest.mark.parametrize(
    ("id", "state", "frames"), [("SkittlesEasy", 0.999, 0.95), (HARD, 0.985, 0.92)]
)
def test_oracles_survive_nearly_always(id, state, frames):
    """With all blocks known only what is beyond sight can trap it; of the frames' blocks one in 512
    is never seen.
    """
    assert oracle_return(make(id), "state", episodes=128).mean() >= state
    assert oracle_return(make(id), "frames", episodes=128).mean() >= frames


def test_random_play_lives_a_little_longer_than_it_must():
    returns = random_return(make(HARD), episodes=512)
    assert 0.12 < returns.mean() < 0.15
    assert returns.min() == pytest.approx(0.1)
