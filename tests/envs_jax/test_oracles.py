"""Oracles reach what the documentation says."""

import numpy as np
import pytest

from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.oracles import (
    RandomPlayer,
    make_oracle,
    oracle_return,
    play,
    random_return,
)

from ..few import few

IDS = [
    f"{name}{level}"
    for name in ("CartPole", "NoisyCartPole", "MineSweeper")
    for level in ("Easy", "Medium", "Hard")
]


@pytest.mark.parametrize("id", IDS)
@pytest.mark.parametrize("rules", few(["default", "reference"], often=["default"]))
def test_the_state_oracle_reaches_the_maximum_in_every_episode(id, rules):
    returns = oracle_return(make(id, rules=rules), "state", episodes=128)
    np.testing.assert_allclose(returns, 1.0, atol=1e-4)


@pytest.mark.parametrize(
    ("id", "least"),
    [
        pytest.param("CartPoleEasy", 0.94, marks=pytest.mark.slow),
        ("NoisyCartPoleEasy", 0.85),
        pytest.param("NoisyCartPoleHard", 0.7, marks=pytest.mark.slow),
        ("MineSweeperEasy", 0.62),
        ("MineSweeperMedium", 0.38),
    ],
)
def test_the_frames_oracle_recovers_most_of_it(id, least):
    """Not all: arrows are coarse or noisy in CartPole, and the first sweeps of a minefield are
    guesses.
    """
    returns = oracle_return(make(id), "frames", episodes=128)
    assert returns.mean() > least


def test_the_frames_oracle_reads_linear_arrows_too():
    assert oracle_return(make("CartPoleEasy", arrow="linear"), "frames", episodes=64).mean() > 0.97


@pytest.mark.parametrize(
    ("id", "low", "high"),
    [
        ("CartPoleEasy", 0.10, 0.17),
        ("CartPoleHard", 0.03, 0.06),
        ("MineSweeperEasy", -0.06, 0.02),
        ("MineSweeperHard", -0.04, 0.02),
    ],
)
def test_random_play_scores_what_is_known_of_it(id, low, high):
    returns = random_return(make(id), episodes=1024)
    assert low < returns.mean() < high


def test_blocks_do_not_change_what_a_deterministic_player_reaches():
    game = make("MineSweeperEasy")
    whole = play(game, make_oracle(game, "frames"), 96, seed=3, frames=True, block=96)
    parts = play(game, make_oracle(game, "frames"), 96, seed=3, frames=True, block=32)
    assert np.array_equal(whole.returns, parts.returns) and np.array_equal(
        whole.lengths, parts.lengths
    )


def test_bad_questions_are_refused():
    game = make("CartPoleEasy")
    with pytest.raises(ValueError, match="kind is 'pixels'"):
        make_oracle(game, "pixels")
    with pytest.raises(ValueError, match="episodes is 0"):
        play(game, RandomPlayer(), 0)


def test_an_oracle_that_is_no_player_is_refused_in_one_line():
    game = make("SignpostEasy")
    game.oracles = {"state": lambda game: 1}
    message = "SignpostEasy-v0: the state oracle is an int, wanted a player with act"
    with pytest.raises(ValueError, match=message):
        make_oracle(game, "state")
