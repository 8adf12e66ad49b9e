"""Breakout, checked against a plain program of its rules and against what its pictures ought to
tell.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from arcade_torch.envs_jax import BatchedGame, env_keys, make
from arcade_torch.envs_jax.breakout import renderer
from arcade_torch.envs_jax.breakout.renderer import KINDS
from arcade_torch.envs_jax.breakout.rules import BreakoutState
from arcade_torch.envs_jax.oracles import RandomPlayer, make_oracle, play

from .conftest import Walk, batched, draw, one, random_actions

WIDTHS = {"BreakoutEasy": 6, "BreakoutMedium": 5, "BreakoutHard": 4}
HARD = "BreakoutHard"
VALUES = [0.025, 0.0216666667, 0.0183333333, 0.015, 0.0116666667, 0.0083333333]
UP_LEFT, UP_RIGHT, DOWN_RIGHT, DOWN_LEFT = range(4)
MOVE = {UP_LEFT: (-1, -1), UP_RIGHT: (1, -1), DOWN_RIGHT: (1, 1), DOWN_LEFT: (-1, 1)}
UPSIDE = {UP_LEFT: DOWN_LEFT, DOWN_LEFT: UP_LEFT, UP_RIGHT: DOWN_RIGHT, DOWN_RIGHT: UP_RIGHT}
SIDES = {UP_LEFT: UP_RIGHT, UP_RIGHT: UP_LEFT, DOWN_LEFT: DOWN_RIGHT, DOWN_RIGHT: DOWN_LEFT}
COMPILED = {}


def plain_step(s, action, width, rules):
    """The rules again, in plain Python: changes ``s``, returns reward, terminated, truncated."""
    move = {2: -1, 3: 1}.get(action, 0)
    if move:
        s.pos = min(max(s.pos + move, 0), 10 - width)
    s.last_x, s.last_y = s.ball_x, s.ball_y
    dx, dy = MOVE[s.ball_dir]
    x, y = s.ball_x + dx, s.ball_y + dy
    if not 0 <= x <= 9:
        x = s.ball_x
        s.ball_dir = SIDES[s.ball_dir]
    reward, touch, lost = 0.0, False, False
    if y < 0:
        y = 0
        s.ball_dir = UPSIDE[s.ball_dir]
    elif 1 <= y <= 6 and s.bricks[y - 1, x]:
        touch = True
        s.bricks[y - 1, x] = False
        if rules == "default" or not s.strike:
            reward = VALUES[y - 1]
            s.score += 1
        if not s.strike:
            y = s.last_y
            s.ball_dir = UPSIDE[s.ball_dir]
    elif y == 19:
        if s.pos <= s.last_x < s.pos + width:
            s.ball_dir, y = UPSIDE[s.ball_dir], 18
        elif s.pos <= x < s.pos + width:
            s.ball_dir, y = UPSIDE[SIDES[s.ball_dir]], 18
        else:
            lost = True
            reward = -s.bricks.sum() / 60
    s.ball_x, s.ball_y, s.strike, s.time = x, y, touch, s.time + 1
    return reward, lost or not s.bricks.any(), s.time >= 2000


def compiled_step(game):
    key = (game.id, game.rules)
    if key not in COMPILED:
        COMPILED[key] = jax.jit(
            jax.vmap(lambda state, action: game.step(jax.random.PRNGKey(0), state, action))
        )
    return COMPILED[key]


def step(game, state, action):
    """One step of one state: state, reward, terminated, truncated."""
    rows = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), state)
    new, reward, terminated, truncated = compiled_step(game)(rows, jnp.full(2, action, jnp.int32))
    new = jax.tree.map(lambda leaf: np.asarray(leaf)[0], new)
    return new, float(reward[0]), bool(terminated[0]), bool(truncated[0])


def random_states(count, width, seed):
    """States anywhere, likely or not: numpy leaves [count, ...]."""
    rng = np.random.default_rng(seed)
    integer = lambda high: rng.integers(0, high, count).astype(np.int32)  # noqa: E731
    bricks = rng.random((count, 6, 10)) < rng.random((count, 1, 1))
    y = np.where(rng.random(count) < 0.3, 18, integer(19)).astype(np.int32)
    return BreakoutState(
        ball_x=integer(10),
        ball_y=y,
        ball_dir=np.where(y == 18, 2 + integer(2), integer(4)).astype(np.int32),
        last_x=integer(10),
        last_y=integer(19),
        pos=integer(11 - width),
        bricks=bricks,
        strike=rng.random(count) < 0.5,
        score=integer(61),
        time=np.where(rng.random(count) < 0.2, 1999, integer(1999)).astype(np.int32),
    )


@pytest.mark.parametrize("id", WIDTHS)
@pytest.mark.parametrize("rules", ["default", "reference"])
def test_any_state_steps_as_the_plain_program_has_it(id, rules):
    states = random_states(1500, WIDTHS[id], seed=1)
    actions = random_actions(1, 1500, seed=2)[0]
    new, reward, terminated, truncated = jax.tree.map(
        np.asarray, compiled_step(make(id, rules=rules))(states, jnp.asarray(actions))
    )
    seen = set()
    for env in range(1500):
        running = {name: leaf[env] for name, leaf in states._asdict().items() if leaf is not None}
        plain = SimpleNamespace(**running)
        plain.bricks = plain.bricks.copy()
        pay, ended, late = plain_step(plain, int(actions[env]), WIDTHS[id], rules)
        plain.terminated, plain.truncated = ended, late
        for name, leaf in new._asdict().items():
            assert np.array_equal(leaf[env], getattr(plain, name)), (env, name)
        assert reward[env] == pytest.approx(pay, abs=1e-6)
        assert (bool(terminated[env]), bool(truncated[env])) == (bool(ended), late)
        seen.add((bool(states.strike[env]), bool(plain.strike), pay < 0, late))
    assert len(seen) >= 8, "some kinds of step never came up"


@settings(max_examples=5, deadline=None)
@given(
    id=st.sampled_from(list(WIDTHS)),
    seed=st.integers(0, 2**31),
    actions=hnp.arrays(np.int32, (40, 16), elements=st.integers(0, 4)),
)
def test_the_paddle_never_leaves_the_board(id, seed, actions):
    pos = Walk(make(id), actions, seed).states.pos
    assert pos.min() >= 0 and pos.max() + WIDTHS[id] <= 10


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("id", WIDTHS)
def test_episodes_start_at_either_wall_and_go_straight_up(id, rules):
    compiled = batched(id, rules=rules)
    batch = compiled.init(env_keys(0, 1024), jnp.zeros(1024, bool))
    fresh = jax.tree.map(np.asarray, batch.state)
    right = fresh.ball_x == 9
    assert abs(right.mean() - 0.5) < 4.5 * 0.5 / 32
    assert ((fresh.ball_x == 0) | right).all() and (fresh.ball_y == 13).all()
    assert np.array_equal(fresh.ball_dir, np.where(right, UP_RIGHT, UP_LEFT))
    assert fresh.bricks.all() and not fresh.strike.any() and not fresh.score.any()
    assert (fresh.pos == (5 if rules == "reference" else min(5, 10 - WIDTHS[id]))).all()
    moved = compiled.step(batch, np.zeros(1024, np.int32))[0].state
    assert np.array_equal(moved.ball_x, fresh.ball_x) and (np.asarray(moved.ball_y) == 12).all()
    assert np.array_equal(moved.ball_dir, np.where(right, UP_LEFT, UP_RIGHT))


def test_a_random_start_is_uniform_and_takes_either_side():
    game = BatchedGame(make(HARD, random_start=True))
    fresh = jax.tree.map(np.asarray, game.init(env_keys(0, 4096), jnp.zeros(4096, bool)).state)
    count = np.bincount(fresh.ball_x * 2 + fresh.ball_dir, minlength=20)
    assert (fresh.ball_dir < 2).all() and (fresh.ball_y == 13).all()
    assert (np.abs(count - 4096 / 20) < 4.5 * np.sqrt(4096 * 0.05 * 0.95)).all()


def test_the_reference_paddle_sticks_out_until_it_is_moved():
    game = make("BreakoutEasy", rules="reference")
    state = one(game)
    assert int(state.pos) == 5
    assert int(step(game, state, 0)[0].pos) == 5
    assert [int(step(game, state, action)[0].pos) for action in (2, 3)] == [4, 4]
    assert draw(game, state, False).shape == (128, 128, 3)


@pytest.mark.parametrize("row", range(1, 7))
def test_a_brick_pays_by_its_row_and_turns_the_ball_round(row):
    game = make(HARD)
    bricks = np.zeros((6, 10), bool)
    bricks[row - 1, 4] = bricks[0, 0] = True
    state = one(game, ball_x=3, ball_y=row + 1, ball_dir=UP_RIGHT, bricks=bricks)
    new, reward, terminated, truncated = step(game, state, 0)
    assert reward == pytest.approx(VALUES[row - 1]) and not terminated and not truncated
    assert (int(new.ball_x), int(new.ball_y), int(new.ball_dir)) == (4, row + 1, DOWN_RIGHT)
    assert int(new.score) == 1 and bool(new.strike) and not new.bricks[row - 1, 4]


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_a_brick_touched_right_after_another_lets_the_ball_pass_and_pays_by_default(rules):
    game = make(HARD, rules=rules)
    state = one(game, ball_x=3, ball_y=4, ball_dir=UP_RIGHT, strike=True)
    new, reward, _, _ = step(game, state, 0)
    assert (int(new.ball_x), int(new.ball_y), int(new.ball_dir)) == (4, 3, UP_RIGHT), (
        "passes through in both"
    )
    assert not new.bricks[2, 4] and bool(new.strike)
    paid = rules == "default"
    assert (reward, int(new.score)) == (pytest.approx(VALUES[2] if paid else 0.0), int(paid))


def test_losing_the_ball_costs_the_share_of_bricks_left():
    game = make(HARD)
    bricks = np.ones((6, 10), bool)
    bricks[5, :3] = False
    state = one(game, ball_x=8, ball_y=18, ball_dir=DOWN_LEFT, pos=0, bricks=bricks)
    new, reward, terminated, truncated = step(game, state, 0)
    assert reward == pytest.approx(-57 / 60) and terminated and not truncated
    assert (int(new.ball_x), int(new.ball_y)) == (7, 19)


def test_the_last_brick_terminates():
    game = make(HARD)
    bricks = np.zeros((6, 10), bool)
    bricks[5, 4] = True
    new, reward, terminated, truncated = step(
        game, one(game, ball_x=3, ball_y=7, ball_dir=UP_RIGHT, bricks=bricks, score=59), 0
    )
    assert (terminated, truncated, int(new.score)) == (True, False, 60)
    assert reward == pytest.approx(VALUES[5])


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_the_time_limit_truncates_but_does_not_terminate(rules):
    game = make(HARD, rules=rules)
    assert game.max_steps == 2000
    assert step(game, one(game, time=1999), 0)[1:] == (0.0, False, True)
    assert step(game, one(game, time=1998), 0)[1:] == (0.0, False, False)


def test_all_bricks_are_worth_one():
    game = make(HARD)
    assert sum(game.screen.score.pictures.shape[:1]) == 61
    assert 10 * sum(VALUES) == pytest.approx(1)
    assert game.return_range == (-1.0, 1.0)


@pytest.mark.parametrize("id", ["BreakoutEasy", HARD])
def test_following_the_ball_clears_the_wall_in_1718_steps(id):
    game = make(id)
    episodes = play(game, make_oracle(game), 4)
    np.testing.assert_allclose(episodes.returns, 1.0, atol=1e-5)
    assert (episodes.lengths == 1718).all()


def test_the_frames_of_the_pomdp_suffice_to_clear_the_wall():
    game = make("BreakoutMedium", random_start=True)
    episodes = play(game, make_oracle(game, "frames"), 3, seed=1, frames=True)
    np.testing.assert_allclose(episodes.returns, 1.0, atol=1e-5)


def test_two_frames_of_an_episode_tell_the_player_of_frames_all_there_is_to_know():
    """Also beside a wall that the ball flies away from, and behind ends. Play is clumsy, so that
    there are some.
    """
    game = make(HARD, random_start=True)
    compiled = BatchedGame(game)
    oracle, rng = make_oracle(game, "frames"), np.random.default_rng(0)
    batch = compiled.init(env_keys(0, 64), jnp.ones(64, bool))
    starts = 0
    for _ in range(120):
        state = jax.tree.map(np.asarray, batch.state)
        begins = state.time == 0
        starts += begins.sum()
        action = oracle.act(np.asarray(compiled.render(batch)), begins)
        for name in ("ball_x", "ball_y", "ball_dir", "pos", "bricks", "strike"):
            believed = np.asarray(getattr(oracle.belief, name))
            np.testing.assert_array_equal(believed[~begins], getattr(state, name)[~begins], name)
        action = np.where(rng.random(64) < 0.3, rng.integers(0, 5, 64), action)
        oracle.action = action.astype(np.int32)
        batch = compiled.step_autoreset(batch, oracle.action)[0]
    assert starts > 100


def test_clumsy_play_pays_what_the_bricks_say():
    """A follower who moves at random 3 times in 10: whatever the path, the return is the bricks'
    worth and the loss.
    """
    game, compiled = make("BreakoutEasy"), batched("BreakoutEasy")
    oracle, rng = make_oracle(game), np.random.default_rng(0)
    batch, running, checked = (
        compiled.init(env_keys(0, 64), jnp.zeros(64, bool)),
        np.ones(64, bool),
        0,
    )
    for _ in range(400):
        action = oracle.act(jax.tree.map(np.asarray, batch.state), running)
        action = np.where(rng.random(64) < 0.3, rng.integers(0, 5, 64), action).astype(np.int32)
        batch, outcome = compiled.step(batch, action)
        ended = running & np.asarray(outcome.done)
        worth = ((~np.asarray(batch.state.bricks)) * np.array(VALUES)[:, None]).sum((1, 2))
        left = np.asarray(batch.state.bricks).sum((1, 2))
        lost = np.where(np.asarray(outcome.terminated), left / 60, 0)
        now = np.asarray(batch.episode_reward)
        np.testing.assert_allclose(now[running], (worth - lost)[running], atol=1e-5)
        assert np.array_equal(np.asarray(batch.state.score)[running], 60 - left[running])
        checked += ended.sum()
        running &= ~ended
    assert checked > 20


def test_random_play_loses_the_ball_soon():
    episodes = play(make("BreakoutEasy"), RandomPlayer(), 256)
    assert -0.96 < episodes.returns.mean() < -0.90
    assert episodes.returns.min() == pytest.approx(-0.975, abs=1e-5), (
        "the ball always meets one brick first"
    )


def codes_of(game, frames):
    return game.screen.board.read(np.asarray(frames), 20, 10)


@pytest.mark.parametrize("size", [128, 256])
def test_the_full_picture_tells_where_the_ball_goes_everywhere(size):
    """Also at walls, corners and in the first frame, where the previous cell would not."""
    compiled = batched(HARD, obs_size=size)
    count = 10 * 19 * 4
    x, y, direction = (axis.ravel().astype(np.int32) for axis in np.mgrid[:10, :19, :4])
    batch = compiled.init(env_keys(0, count), jnp.zeros(count, bool))
    bricks = np.zeros((count, 6, 10), bool)
    state = batch.state._replace(ball_x=x, ball_y=y, ball_dir=direction, bricks=bricks)
    codes = codes_of(compiled.game, compiled.render(batch._replace(state=state)))
    assert (codes >= 0).all()
    assert len(np.unique(codes.reshape(count, -1), axis=0)) == count


@pytest.mark.parametrize("size", [128, 256])
def test_ball_tail_bricks_and_paddle_can_be_read_back(size):
    game = make(HARD, obs_size=size)
    bricks = np.ones((6, 10), bool)
    bricks[4, 2:5] = False
    state = one(
        game, ball_x=5, ball_y=8, ball_dir=DOWN_LEFT, pos=3, bricks=bricks, last_x=5, last_y=8
    )
    expected = np.zeros((20, 10), int)
    expected[1:7] = np.where(bricks, np.arange(1, 7)[:, None], 0)
    expected[19, 3:7] = 1  # the paddle has the colour of the uppermost bricks
    hidden = expected.copy()
    expected[8, 5], expected[7, 6] = renderer.BALL * KINDS, renderer.TAIL * KINDS
    assert np.array_equal(codes_of(game, draw(game, state, False)[None])[0], expected)
    assert np.array_equal(codes_of(game, draw(game, state, True)[None])[0], hidden)
    upwards = state._replace(ball_dir=jnp.int32(UP_LEFT))
    hidden[8, 5] = renderer.BALL * KINDS
    assert np.array_equal(codes_of(game, draw(game, upwards, True)[None])[0], hidden)


def test_the_literal_tail_is_where_the_ball_was():
    game = make(HARD, tail="previous", obs_size=256)  # at 128 the tail covers the ball
    render = jax.jit(game.render)
    first = one(game, ball_x=3, ball_y=9, last_x=3, last_y=9)
    assert codes_of(game, render(first, False)[None])[0, 9, 3] == renderer.BALL_TAIL * KINDS
    moved = first._replace(last_x=jnp.int32(4))
    assert codes_of(game, render(moved, False)[None])[0, 9, 4] == renderer.TAIL * KINDS
    for direction in range(4):
        same = render(moved._replace(ball_dir=jnp.int32(direction)), False)
        assert np.array_equal(same, render(moved, False)), (
            "the literal tail does not tell the direction"
        )
    with pytest.raises(ValueError, match="tail is 'long'"):
        make(HARD, tail="long")
    with pytest.raises(TypeError, match="random_start"):
        make(HARD, random_start=1)


def test_in_play_the_pomdp_hides_the_ball_on_its_way_down_and_the_tail_always():
    game, compiled = make("BreakoutEasy"), batched("BreakoutEasy")
    oracle = make_oracle(game)
    batch = compiled.init(env_keys(0, 8), jnp.zeros(8, bool))
    shown = 0
    for _ in range(60):
        state = jax.tree.map(np.asarray, batch.state)
        full, partial = (
            codes_of(game, compiled.render(batch._replace(partial=jnp.full(8, flag))))
            for flag in (False, True)
        )
        assert np.array_equal(full % KINDS, partial % KINDS), (
            "bricks and paddle are the same in both"
        )
        marks = partial // KINDS
        up = state.ball_dir < 2
        assert np.array_equal(marks.sum((1, 2)), np.where(up, renderer.BALL, 0))
        assert (marks[up, state.ball_y[up], state.ball_x[up]] == renderer.BALL).all()
        shown += up.sum()
        batch, _ = compiled.step(batch, oracle.act(state, up))
    assert 100 < shown < 400


def test_every_visible_variable_changes_the_mdp_picture():
    game = make(HARD)
    base = one(game, ball_x=4, ball_y=10, ball_dir=UP_LEFT)
    frame = draw(game, base, False)
    fewer = base.bricks.at[3, 3].set(False)
    for changes in (
        {"ball_x": 5},
        {"ball_y": 9},
        {"ball_dir": 3},
        {"pos": 4},
        {"bricks": fewer},
        {"score": 1},
    ):
        changed = base._replace(
            **{name: jnp.asarray(v, getattr(base, name).dtype) for name, v in changes.items()}
        )
        assert not np.array_equal(frame, draw(game, changed, False)), changes


def test_a_tile_that_the_atlas_does_not_have_reads_as_minus_one():
    game = make(HARD)
    frame = draw(game, one(game), False)[None].copy()
    board = game.screen.board
    frame[0, board.y + 1, board.x + 1] = (1, 2, 3)
    codes = codes_of(game, frame)[0]
    assert codes[0, 0] == -1 and (codes.ravel()[1:] >= 0).all()
