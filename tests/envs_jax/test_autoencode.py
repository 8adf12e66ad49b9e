"""AutoEncode: a deal, a watch, a stack to pop; and the suits that the card games share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.envs_jax import env_keys, make
from arcade_torch.envs_jax.cards import deal
from arcade_torch.envs_jax.oracles import make_oracle, play, random_return
from arcade_torch.envs_jax.render.palette import BLACK, RED, SMOKE
from arcade_torch.envs_jax.render.suits import suit_mask, suit_pictures

from .conftest import batched, draw, one, random_actions, step

CARDS = {"AutoEncodeEasy": 26, "AutoEncodeMedium": 52, "AutoEncodeHard": 78}
UP, DOWN, LEFT, RIGHT, FIRE = range(5)
KEY = jax.random.PRNGKey(0)


def run(game, state, actions):
    """Rewards and flags of a fixed list of actions."""
    rewards, ends = [], []
    for action in actions:
        state, reward, terminated, truncated = step(game, state, action)
        rewards.append(reward)
        ends.append((terminated, truncated))
    return state, rewards, ends


def read_history(frames, screen, rows=9):
    """Codes of the history, int [N, rows * 9]."""
    return screen.history.read(
        frames[:, :, : screen.history.x + 9 * screen.history.atlas.shape[1]], 9, 9
    )[:, :rows].reshape(len(frames), -1)


# The deal and the suits, shared with CountRecall


@pytest.mark.parametrize(("cards", "suits"), [(26, 4), (52, 4), (78, 4), (26, 2), (52, 2)])
def test_a_deal_holds_every_suit_as_evenly_as_can_be(cards, suits):
    packs = np.asarray(jax.jit(lambda key: deal(key, 500, cards, suits))(KEY))
    expected = np.bincount(np.arange(cards) % suits, minlength=suits)
    for suit in range(suits):
        assert ((packs == suit).sum(1) == expected[suit]).all()
        rate = expected[suit] / cards
        z = ((packs == suit).sum(0) - 500 * rate) / np.sqrt(500 * rate * (1 - rate))
        assert np.abs(z).max() < 4.5, "some place prefers a suit"
    again = (packs[:, 1:] == packs[:, :-1]).mean()
    without_order = (expected * (expected - 1)).sum() / (cards * (cards - 1))
    assert abs(again - without_order) < 0.015, "neighbours ought to be as alike as any two cards"
    assert len(np.unique(packs, axis=0)) == 500


@pytest.mark.parametrize("height", [9, 14, 17, 18, 20, 34, 40])
def test_suits_are_symmetric_and_clearly_different(height):
    width = {9: 8, 18: 12, 34: 20, 40: 20}.get(height, 10)
    masks = [suit_mask(suit, height, width) for suit in range(4)]
    for mask in masks:
        assert np.array_equal(mask, mask[:, ::-1])
        assert mask.any(0).all() and 0.3 < mask.mean() < 0.9
        assert mask.any(1).sum() >= height - 2
    for a in range(4):
        for b in range(a):
            assert (masks[a] != masks[b]).mean() > 0.08, (a, b)


def test_two_suits_are_red_and_two_black():
    pictures = suit_pictures((20, 10), (20, 10), SMOKE, shorter=3)
    assert (pictures[0] == SMOKE).all()
    for picture, colour in zip(pictures[1:], (RED, BLACK, BLACK, RED), strict=True):
        assert {tuple(pixel) for pixel in picture.reshape(-1, 3)} == {colour, SMOKE}
        assert (picture[-3:] == SMOKE).all() == (colour == BLACK)


# The law


@pytest.mark.parametrize("id", CARDS)
def test_an_episode_begins_with_a_full_deal_and_the_selector_on_hearts(id):
    compiled = batched(id)
    fresh = jax.tree.map(np.asarray, compiled.init(env_keys(0, 64), jnp.zeros(64, bool)).state)
    assert fresh.cards.shape == (64, CARDS[id]) and fresh.cards.dtype == np.int8
    assert (np.sort(fresh.cards) == np.sort(np.arange(CARDS[id]) % 4)).all()
    assert all((leaf == 0).all() for leaf in fresh[1:])
    assert compiled.game.max_steps == 10 * CARDS[id]


def test_left_turns_the_selector_on_and_right_back_in_both_phases():
    game = make("AutoEncodeEasy")
    for timestep in (3, 40):
        for selected in range(4):
            for action, turned in ((UP, 0), (DOWN, 0), (LEFT, 1), (RIGHT, -1), (FIRE, 0)):
                new = step(game, one(game, timestep=timestep, selected=selected), action)[0]
                assert int(new.selected) == (selected + turned) % 4


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31))
@pytest.mark.parametrize("rules", ["default", "reference"])
def test_nothing_the_player_does_during_the_watch_counts(rules, seed):
    game = batched("AutoEncodeEasy", rules=rules)
    batch = game.init(env_keys(seed, 16), jnp.zeros(16, bool))
    for action in random_actions(26, 16, seed=seed):
        batch, outcome = game.step(batch, action)
        assert not np.asarray(outcome.reward).any() and not np.asarray(outcome.done).any()
    assert not np.asarray(batch.state.given).any() and not np.asarray(batch.state.score).any()
    assert (np.asarray(batch.state.timestep) == 26).all()


@pytest.mark.parametrize("rules", ["default", "reference"])
@pytest.mark.parametrize("action", [UP, LEFT])
def test_only_fire_answers_but_the_reference_takes_the_first_step_for_an_answer(rules, action):
    """A1."""
    game = make("AutoEncodeEasy", rules=rules)
    cards = np.zeros(26, np.int8)
    cards[-1] = 1 if action == LEFT else 0
    state = one(game, cards=cards, timestep=26)
    new, reward, *_ = step(game, state, action)
    forced = rules == "reference"
    assert int(new.given) == int(new.score) == forced
    assert reward == (pytest.approx(1 / 26) if forced else 0)
    later, reward, *_ = step(game, new, UP)
    assert (int(later.given), reward) == (int(forced), 0)


def test_a_wrong_answer_pays_nothing_and_consumes_its_card():
    game = make("AutoEncodeEasy")
    cards = np.zeros(26, np.int8)
    cards[-2:] = (2, 3)
    new, reward, *_ = step(game, one(game, cards=cards, timestep=30, selected=2), FIRE)
    assert (int(new.given), int(new.score), reward) == (1, 0, 0)
    new, reward, *_ = step(game, new, FIRE)
    assert (int(new.given), int(new.score), reward) == (2, 1, pytest.approx(1 / 26))


def test_the_last_answer_ends_the_episode_and_nothing_is_paid_after_it():
    """A2 and A3."""
    game = make("AutoEncodeEasy")
    state = one(game, cards=np.zeros(26), timestep=60, given=24, score=24)
    state, rewards, ends = run(game, state, [FIRE, FIRE, FIRE, FIRE])
    assert rewards == [pytest.approx(1 / 26)] * 2 + [0, 0]
    assert ends[:2] == [(False, False), (True, False)]
    assert int(state.score) == 26


def test_the_reference_pays_the_first_card_twice_and_ends_a_step_late():
    """A2 and A3: flags agree with the end there too."""
    game = make("AutoEncodeEasy", rules="reference")
    state = one(game, cards=np.zeros(26), timestep=60, given=24, score=24)
    state, rewards, ends = run(game, state, [FIRE, FIRE, FIRE, FIRE])
    assert rewards == [pytest.approx(1 / 26)] * 3 + [0]
    assert ends[:3] == [(False, False), (False, False), (True, False)]
    assert int(state.score) == 27
    assert draw(game, state, False).shape == (128, 128, 3)


@pytest.mark.parametrize("id", CARDS)
@pytest.mark.parametrize("rules", ["default", "reference"])
def test_the_time_limit_truncates_but_does_not_terminate(id, rules):
    """A4: the reference truncates one step late. A9: the limit is ten steps a card."""
    game = make(id, rules=rules)
    limit = 10 * CARDS[id]
    for steps_before in (2, 1, 0):
        _, _, terminated, truncated = step(game, one(game, timestep=limit - steps_before), UP)
        assert not terminated and truncated is (steps_before <= (rules == "default"))


def test_both_flags_can_be_true_at_once():
    game = make("AutoEncodeEasy")
    new, reward, terminated, truncated = step(
        game, one(game, cards=np.zeros(26), timestep=259, given=25, score=25), FIRE
    )
    assert (terminated, truncated, int(new.given)) == (True, True, 26) and reward > 0


# Pictures


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("id", ["AutoEncodeEasy", "AutoEncodeHard"])
def test_card_selector_and_stack_can_be_read_back(id, size):
    """A6 and A7: the stack is legible at every size, and an answered card is gone from it."""
    game = make(id, obs_size=size)
    cards = CARDS[id]
    for timestep, count, selected in (
        (0, 0, 0),
        (5, 0, 1),
        (cards - 1, 0, 2),
        (cards, 0, 3),
        (cards + 20, 7, 0),
    ):
        state = one(game, timestep=timestep, given=count, selected=selected, score=count)
        full, partial = (draw(game, state, flag)[None] for flag in (False, True))
        suits = np.asarray(state.cards)
        expected = np.zeros(9 * -(-cards // 9), int)
        shown = min(timestep, cards) - count
        expected[:shown] = 1 + suits[:shown]
        assert np.array_equal(read_history(full, game.screen, len(expected) // 9)[0], expected)
        assert not read_history(partial, game.screen, len(expected) // 9).any()
        for frame in (full, partial):
            assert game.screen.card.read(frame)[0] == (
                1 + suits[timestep] if timestep < cards else 0
            )
            assert game.screen.selector.read(frame)[0] == 1 + selected
            assert game.screen.score.read(frame)[0] == count
        low = game.screen.history.y
        differs = (full != partial).any((0, 2, 3))
        assert (
            not differs[:low].any()
            and not differs[low + 9 * game.screen.history.atlas.shape[1] :].any()
        )


@pytest.mark.parametrize(
    ("rules", "marker", "removed"),
    [
        ("default", None, True),
        ("default", False, False),
        ("reference", None, False),
        ("reference", True, True),
    ],
)
def test_the_marker_option_decides_whether_answers_show_in_the_mdp(rules, marker, removed):
    """A6."""
    game = make("AutoEncodeEasy", rules=rules, mdp_marker=marker)
    render = jax.jit(game.render)
    state = one(game, timestep=40, given=10)
    codes = read_history(np.asarray(render(state, False))[None], game.screen, 3)
    assert (codes > 0).sum() == (16 if removed else 26)
    more = state._replace(given=jnp.int32(11))
    assert np.array_equal(render(more, False), render(state, False)) is not removed
    assert np.array_equal(render(more, True), render(state, True)), (
        "the POMDP never shows the count"
    )


def test_every_visible_variable_changes_the_mdp_picture():
    game = make("AutoEncodeEasy")
    base = one(game, timestep=9, selected=1)
    frame = draw(game, base, False)
    earlier = base.cards.at[2].set((base.cards[2] + 1) % 4)
    current = base.cards.at[9].set((base.cards[9] + 1) % 4)
    for changes in (
        {"cards": earlier},
        {"cards": current},
        {"timestep": 10},
        {"selected": 2},
        {"score": 1},
        {"given": 1},
    ):
        changed = base._replace(
            **{k: jnp.asarray(v, getattr(base, k).dtype) for k, v in changes.items()}
        )
        assert not np.array_equal(frame, draw(game, changed, False)), changes
    to_come = base._replace(cards=base.cards.at[15].set((base.cards[15] + 1) % 4))
    assert np.array_equal(frame, draw(game, to_come, False)), "cards to come are hidden"


def test_a_bad_marker_is_refused():
    with pytest.raises(ValueError, match="mdp_marker is 'no'"):
        make("AutoEncodeEasy", mdp_marker="no")


# Players


@pytest.mark.parametrize("id", CARDS)
def test_the_state_oracle_returns_one_within_four_steps_a_card(id):
    game = make(id)
    episodes = play(game, make_oracle(game), 64)
    np.testing.assert_allclose(episodes.returns, 1, atol=1e-5)
    assert episodes.lengths.max() <= 4 * CARDS[id]


def test_the_oracles_reach_the_highest_return_of_the_reference():
    game = make("AutoEncodeEasy", rules="reference")
    for kind in ("state", "frames"):
        returns = play(game, make_oracle(game, kind), 32, frames=kind == "frames").returns
        np.testing.assert_allclose(returns, game.return_range[1], atol=1e-5)
    assert game.return_range[1] == pytest.approx(27 / 26)


@pytest.mark.parametrize("id", ["AutoEncodeEasy", "AutoEncodeHard"])
def test_memory_of_the_frames_recovers_everything(id):
    game = make(id)
    np.testing.assert_allclose(
        play(game, make_oracle(game, "frames"), 32, frames=True).returns, 1, atol=1e-5
    )


def test_a_blind_player_is_right_in_one_of_four_answers():
    returns = random_return(make("AutoEncodeEasy"), 512)
    assert abs(returns.mean() - 0.25) < 0.012
    assert returns.min() >= 0 and returns.max() < 1
