"""CountRecall: counting by brute force, the counter's range, and what the limit leaves."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.envs_jax import env_keys, make
from arcade_torch.envs_jax.countrecall.oracle import SKIP, best_plan, right_answers
from arcade_torch.envs_jax.oracles import make_oracle, play, random_return
from arcade_torch.envs_jax.render import Slot

from .conftest import batched, draw, going_on, one, random_actions, step
from .test_autoencode import read_history

LEVELS = {
    "CountRecallEasy": (26, 2, 13),
    "CountRecallMedium": (52, 2, 26),
    "CountRecallHard": (78, 4, 20),
}
UP, DOWN, LEFT, RIGHT, FIRE = range(5)


@pytest.mark.parametrize("id", LEVELS)
def test_packs_are_full_and_independent(id):
    cards, suits, most = LEVELS[id]
    compiled = batched(id)
    fresh = jax.tree.map(np.asarray, compiled.init(env_keys(0, 1024), jnp.zeros(1024, bool)).state)
    for pack in (fresh.cards, fresh.queries):
        assert (np.sort(pack) == np.sort(np.arange(cards) % suits)).all()
        assert ((pack == 0).mean(0) > 0.8 / suits).all() and (
            (pack == 0).mean(0) < 1.2 / suits + 0.05
        ).all()
    assert abs((fresh.cards == fresh.queries).mean() - 1 / suits) < 0.01, (
        "queries ought not to follow the cards"
    )
    assert all((leaf == 0).all() for leaf in fresh[2:])
    assert (compiled.game.max_steps, compiled.game.level.most) == (100 + cards, most)


@pytest.mark.parametrize("id", LEVELS)
def test_the_right_answer_counts_the_cards_of_earlier_turns(id):
    """R2: the card on the table is not counted, so the first answer is 0."""
    game = make(id)
    state = one(game)
    cards, queries = np.asarray(state.cards), np.asarray(state.queries)
    for turn in range(0, len(cards), 5):
        count = int((cards[:turn] == queries[turn]).sum())
        for answer in {0, count, min(count + 1, game.level.most)}:
            here = state._replace(timestep=jnp.int32(turn), answer=jnp.int32(answer))
            new, reward, *_ = step(game, here, FIRE)
            right = answer == count
            assert reward == (pytest.approx(1 / len(cards)) if right else 0)
            assert (int(new.score), int(new.timestep), int(new.answer), int(new.moves)) == (
                right,
                turn + 1,
                answer,
                1,
            )
        assert turn or count == 0


def test_the_counter_moves_by_one_and_the_other_actions_only_pass_time():
    game = make("CountRecallEasy")
    for action, change in ((UP, 1), (DOWN, -1), (LEFT, 0), (RIGHT, 0)):
        new, reward, terminated, truncated = step(
            game, one(game, answer=5, timestep=3, moves=9), action
        )
        assert (int(new.answer), int(new.timestep), int(new.moves)) == (5 + change, 3, 10)
        assert (reward, terminated, truncated) == (0, False, False)


@pytest.mark.parametrize("id", LEVELS)
def test_the_counter_is_held_in_the_range_of_possible_answers(id):
    """R1."""
    game, most = make(id), LEVELS[id][2]
    assert int(step(game, one(game, answer=0), DOWN)[0].answer) == 0
    assert int(step(game, one(game, answer=most), UP)[0].answer) == most
    assert int(step(game, one(game, answer=most - 1), UP)[0].answer) == most
    fresh = batched(id).init(env_keys(1, 256), jnp.zeros(256, bool)).state
    wanted = right_answers(np.asarray(fresh.cards), np.asarray(fresh.queries))
    assert wanted.max() <= most, "an answer would be out of reach"


def test_the_counter_of_the_reference_goes_anywhere_and_is_drawn_as_it_is():
    """R1: the law is free, the picture stays legible."""
    game = make("CountRecallEasy", rules="reference")
    assert int(step(game, one(game, answer=0), DOWN)[0].answer) == -1
    assert int(step(game, one(game, answer=13), UP)[0].answer) == 14
    pictures = game.screen.counter.pictures.reshape(len(game.screen.counter.pictures), -1)
    assert len(np.unique(pictures, axis=0)) == len(pictures) == 99 + 126 + 1
    for answer in (-99, -1, 0, 9, 100, 126):
        frame = draw(game, one(game, answer=answer, score=26), False)[None]
        assert game.screen.counter.read(frame)[0] - 99 == answer
        assert digits(game.screen.score).read(frame)[0] == 26
    assert np.array_equal(
        draw(game, one(game, answer=-120), False), draw(game, one(game, answer=-99), False)
    )


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("id", LEVELS)
def test_the_last_turn_terminates_and_the_limit_truncates(id, rules):
    """Neither comes late, in the reference neither."""
    game, (cards, *_) = make(id, rules=rules), LEVELS[id]
    for timestep, moves, action, ends in (
        (cards - 1, 50, FIRE, (True, False)),
        (cards - 1, 50, UP, (False, False)),
        (cards - 2, 50, FIRE, (False, False)),
        (3, 99 + cards, UP, (False, True)),
        (3, 98 + cards, FIRE, (False, False)),
        (cards - 1, 99 + cards, FIRE, (True, True)),
    ):
        new, _, terminated, truncated = step(
            game, one(game, timestep=timestep, moves=moves), action
        )
        assert (terminated, truncated) == ends
    assert step(game, new, FIRE)[1] == 0, "there is no turn after the last"


def test_the_move_budget_sets_the_limit():
    """R3."""
    game = make("CountRecallHard", move_budget=300)
    assert game.max_steps == 378
    assert not step(game, one(game, moves=376), UP)[3] and step(game, one(game, moves=377), UP)[3]
    np.testing.assert_allclose(play(game, make_oracle(game), 32).returns, 1, atol=1e-5)
    for wrong in (-1, 801, 1.5, True, "many"):
        with pytest.raises(ValueError, match="move_budget is"):
            make("CountRecallHard", move_budget=wrong)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), up=st.floats(0, 1))
def test_whatever_is_played_the_score_equals_a_recount(seed, up):
    """The rewards of random strings of actions, checked against counting by hand."""
    compiled = batched("CountRecallEasy")
    batch = compiled.init(env_keys(seed, 16), jnp.zeros(16, bool))
    cards, queries = np.asarray(batch.state.cards), np.asarray(batch.state.queries)
    actions = random_actions(40, 16, seed=seed)
    actions[np.random.default_rng(seed).random(actions.shape) < up * 0.5] = FIRE
    answer, turn, score = np.zeros((3, 16), int)
    running = np.ones(16, bool)
    for action in actions:
        batch, outcome = compiled.step(going_on(batch), action)
        answer = np.clip(answer + (action == UP) - (action == DOWN), 0, 13)
        for env in np.flatnonzero((action == FIRE) & running):
            dealt = np.sum(cards[env, : turn[env]] == queries[env, turn[env]])
            assert (float(outcome.reward[env]) > 0) == (dealt == answer[env])
            score[env] += dealt == answer[env]
            turn[env] += 1
        assert np.array_equal(np.asarray(outcome.terminated), turn >= 26)
        running &= turn < 26
        assert np.array_equal(np.asarray(batch.state.answer), answer)
        assert np.array_equal(np.asarray(batch.state.score), score)
    np.testing.assert_allclose(np.asarray(batch.episode_reward), score / 26, atol=1e-5)


def digits(slot):
    """The columns of a slot in which some digit stands; the counter's place covers empty ones of
    the score's.
    """
    used = np.flatnonzero((slot.pictures != slot.pictures[0, 0, 0]).any((0, 1, 3)))
    low, high = used.min(), used.max() + 1
    return Slot(slot.pictures[:, :, low:high], slot.x + int(low), slot.y)


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("id", ["CountRecallEasy", "CountRecallHard"])
def test_everything_shown_can_be_read_back(id, size):
    """R5: the history has as many legible symbols as turns were confirmed, and the POMDP hides it
    alone.
    """
    game = make(id, obs_size=size)
    cards, _, most = LEVELS[id]
    rows = -(-cards // 9)
    for turn, answer, score in (
        (0, 0, 0),
        (1, 9, 1),
        (20, 10, 7),
        (cards - 1, most, cards - 1),
        (cards, 3, cards),
    ):
        state = one(game, timestep=turn, answer=answer, score=score)
        full, partial = (draw(game, state, flag)[None] for flag in (False, True))
        expected = np.zeros(9 * rows, int)
        expected[:turn] = 1 + np.asarray(state.cards)[:turn]
        assert np.array_equal(read_history(full, game.screen, rows)[0], expected)
        assert not read_history(partial, game.screen, rows).any()
        for frame in (full, partial):
            for slot, pack in ((game.screen.card, state.cards), (game.screen.query, state.queries)):
                assert slot.read(frame)[0] == (1 + int(pack[turn]) if turn < cards else 0)
            assert game.screen.counter.read(frame)[0] == answer
            assert digits(game.screen.score).read(frame)[0] == score
        low = game.screen.history.y
        differs = (full != partial).any((0, 2, 3))
        assert (
            not differs[:low].any()
            and not differs[low + 9 * game.screen.history.atlas.shape[1] :].any()
        )


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("rules", ["default", "reference"])
def test_counter_score_and_cards_do_not_touch(size, rules):
    screen = make("CountRecallHard", obs_size=size, rules=rules).screen
    score = (screen.score.pictures != screen.score.pictures[0, 0, 0]).any((0, 1, 3))
    counter = screen.counter
    assert screen.score.x + np.flatnonzero(score).max() < counter.x
    assert counter.x + counter.pictures.shape[2] <= screen.query.x


def test_every_visible_variable_changes_the_mdp_picture():
    game = make("CountRecallEasy")
    base = one(game, timestep=9, answer=4)
    frame = draw(game, base, False)
    for changes in (
        {"cards": base.cards.at[2].set(1 - base.cards[2])},
        {"cards": base.cards.at[9].set(1 - base.cards[9])},
        {"queries": base.queries.at[9].set(1 - base.queries[9])},
        {"timestep": 10},
        {"answer": 5},
        {"score": 1},
    ):
        changed = base._replace(
            **{k: jnp.asarray(v, getattr(base, k).dtype) for k, v in changes.items()}
        )
        assert not np.array_equal(frame, draw(game, changed, False)), changes
    to_come = base._replace(
        cards=base.cards.at[15].set(1 - base.cards[15]),
        queries=base.queries.at[3].set(1 - base.queries[3]),
    )
    assert np.array_equal(frame, draw(game, to_come, False)), (
        "cards to come and earlier queries are hidden"
    )


def test_the_plan_is_as_good_as_trying_every_choice():
    generator = np.random.default_rng(0)
    wanted = generator.integers(0, 5, (20, 8))
    for budget in (0, 3, 7, 12):
        plan = best_plan(wanted, budget)
        for row, chosen in zip(wanted, plan, strict=True):
            assert ((chosen == SKIP) | (chosen == row)).all()
            path = [0, *chosen[chosen != SKIP]]
            assert np.abs(np.diff(path)).sum() <= budget
            best = max(
                len(turns)
                for size in range(9)
                for turns in itertools.combinations(range(8), size)
                if np.abs(np.diff([0, *row[list(turns)]])).sum() <= budget
            )
            assert (chosen != SKIP).sum() == best


@pytest.mark.parametrize(
    ("id", "mean", "all_right"),
    [
        ("CountRecallEasy", 1, 1),
        ("CountRecallMedium", 0.993, 0.85),
        ("CountRecallHard", 0.959, 0.29),
    ],
)
def test_the_state_oracle_reaches_what_the_limit_leaves(id, mean, all_right):
    """R3: the documented means of the best play."""
    game = make(id)
    returns = play(game, make_oracle(game), 256).returns
    assert abs(returns.mean() - mean) < 0.007
    assert abs((returns > 0.9999).mean() - all_right) < 0.09


@pytest.mark.parametrize(
    ("id", "least"),
    [("CountRecallEasy", 0.9999), ("CountRecallMedium", 0.975), ("CountRecallHard", 0.895)],
)
def test_counting_the_frames_recovers_most_of_it(id, least):
    """All on Easy; elsewhere it cannot know which answers are better given up for want of moves."""
    game = make(id)
    assert play(game, make_oracle(game, "frames"), 64, frames=True).returns.mean() > least


def test_random_play_stays_in_range():
    game = make("CountRecallEasy")
    returns = random_return(game, 512)
    assert returns.min() >= 0 and returns.max() <= 1 and 0.05 < returns.mean() < 0.3
