"""Laws of several games in one batch: every env walks the path it walks alone."""

import re
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arcade_torch.envs_jax import MixedGames, env_keys, make
from tests.arcade_torch.stub import MIXED, CoinGame, StubGame

from .conftest import ALL_IDS, batched, random_actions
from .test_batch import rows, same

GAMES = [make("CartPoleEasy"), make("MineSweeperEasy")]


def walk(compiled, keys, actions, partial):
    """Everything that `step_autoreset` gives over some steps."""
    batch = compiled.init(keys, partial)
    for action in actions:
        batch, stepped, outcome, frames = compiled.step_autoreset(batch, action)
        yield batch, stepped, outcome, frames


@pytest.mark.parametrize(
    ("games", "weights"),
    [(GAMES, (1, 2)), pytest.param(None, (1,) * 10, marks=pytest.mark.slow, id="all ten games")],
)
def test_env_i_walks_the_path_that_it_walks_in_its_game_alone(games, weights):
    mixed, size = (
        MixedGames(games or [make(id) for id in ALL_IDS if "Easy" in id], weights),
        2 * sum(weights),
    )
    games, parts = mixed.game.games, mixed.rows(size)
    keys, actions, partial = env_keys(5, size), random_actions(50, size), jnp.arange(size) % 2 == 0
    together = walk(mixed, keys, actions, partial)
    apart = [
        walk(batched(g.id), keys[r], actions[:, r], partial[r])
        for g, r in zip(games, parts, strict=True)
    ]
    ends = np.zeros(size, int)
    for now, *alone in zip(together, *apart, strict=True):
        root, stepped, outcome, frames = now
        for game, part, (root1, stepped1, outcome1, frames1) in zip(
            games, parts, alone, strict=True
        ):
            for ours, theirs in ((root, root1), (stepped, stepped1)):
                assert same(rows(ours._replace(state=None), part), theirs._replace(state=None))
                assert same(ours.state[game.id], theirs.state)
            assert same(rows(outcome, part), outcome1)
            assert np.array_equal(np.asarray(frames)[part], frames1)
        ends += np.asarray(outcome.done)
    assert (ends > 0).sum() >= 6, "enough envs ought to have ended an episode"


def test_the_fused_step_equals_step_then_reset_and_the_frame_follows_from_the_state():
    mixed = MIXED.batched
    fused = apart = mixed.init(env_keys(0, 6), jnp.arange(6) % 2 == 0)
    for action in random_actions(30, 6):
        fused, stepped, outcome, frames = mixed.step_autoreset(fused, action)
        before, outcome_apart, final_frames = mixed.step_render(apart, action)
        apart, root_frames = mixed.reset_render(before, outcome_apart.done)
        assert same(fused, apart) and same(stepped, before) and same(outcome, outcome_apart)
        assert np.array_equal(frames, root_frames) and np.array_equal(frames, mixed.render(fused))
        assert np.array_equal(final_frames, mixed.render(before))


def test_padding_makes_every_leaf_as_long_as_the_batch_and_unpadding_undoes_it():
    mixed = MIXED.batched
    batch = mixed.init(env_keys(3, 6), jnp.zeros(6, bool))
    padded = mixed.pad(batch)
    assert all(len(leaf) == 6 for leaf in jax.tree.leaves(padded))
    assert same(mixed.unpad(padded), batch)
    assert not np.asarray(padded.state["CoinEasy-v0"].count)[:4].any(), (
        "zero where another game is played"
    )


@given(weights=st.lists(st.integers(1, 9), min_size=1, max_size=6), extra=st.integers(0, 200))
def test_envs_are_split_in_order_and_as_the_weights_say(weights, extra):
    games = [StubGame(id=f"Stub{i}-v0") for i in range(len(weights))]
    mixed, num_envs = MixedGames(games, weights), sum(weights) + extra
    parts = mixed.rows(num_envs)
    assert parts[0].start == 0 and parts[-1].stop == num_envs
    assert all(before.stop == after.start for before, after in pairwise(parts))
    sizes = np.array([part.stop - part.start for part in parts])
    assert (np.abs(sizes - num_envs * np.array(weights) / sum(weights)) < 1).all()
    assert mixed.task(num_envs).tolist() == sorted(mixed.task(num_envs))
    assert np.array_equal(np.bincount(mixed.task(num_envs), minlength=len(weights)), sizes)


def test_a_mixture_is_known_by_what_its_games_have_in_common():
    game = MixedGames(GAMES, weights=(2, 1)).game
    assert game.id == "2*CartPoleEasy-v0+MineSweeperEasy-v0"
    assert (game.max_steps, game.return_range[1], game.obs_size, game.rules) == (
        200,
        1.0,
        128,
        "default",
    )
    assert game.return_range[0] == GAMES[1].return_range[0] < GAMES[0].return_range[0]
    assert game.num_actions == 5 and "2*CartPoleEasy-v0" in repr(game)
    assert MixedGames([GAMES[0], make("TetrisEasy", rules="reference")]).game.rules == "mixed"


@pytest.mark.parametrize(
    ("games", "weights", "message"),
    [
        ([], None, "the list of games is empty"),
        (
            [StubGame(), StubGame()],
            None,
            "StubEasy-v0 is in the list of games twice: give it once, with a weight",
        ),
        (
            [StubGame(), GAMES[0]],
            None,
            "picture size, these have obs_size 8 (StubEasy-v0), 128 (CartPoleEasy-v0)",
        ),
        ([StubGame(), CoinGame()], (1,), "weights are (1,), expected 2 whole numbers of 1 or more"),
        (
            [StubGame(), CoinGame()],
            (1, 0),
            "weights are (1, 0), expected 2 whole numbers of 1 or more",
        ),
        ([StubGame(), CoinGame()], (1.5, 1), "weights are (1.5, 1), expected 2 whole numbers"),
        ([StubGame(), CoinGame()], (True, 1), "weights are (True, 1), expected 2 whole numbers"),
    ],
)
def test_games_that_cannot_share_a_batch_are_refused(games, weights, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MixedGames(games, weights)


def test_too_few_envs_are_refused():
    with pytest.raises(
        ValueError, match=re.escape("num_envs is 1, too few for 2*StubEasy-v0+CoinEasy-v0")
    ):
        MIXED.batched.rows(1)
