"""One agent that learns several games: its numbers, its run, and what it earns in each."""

import json

import numpy as np
import pytest

from arcade_torch.agents import evaluate, load, preset, train
from arcade_torch.agents.evaluation import make_env
from arcade_torch.agents.runs.files import read_csv
from tests.agents.test_training import assert_goes_on_to_the_bit

GAMES = ["CartPoleEasy-v0", "SkittlesEasy-v0"]
MIXTURE = "CartPoleEasy-v0+2*SkittlesEasy-v0"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run that was interrupted once."""
    config = preset(
        "smoke",
        env=MIXTURE,
        observability="partial",
        checkpoint_every=64,
        eval_every=256,
        eval_episodes=12,
    )
    return assert_goes_on_to_the_bit(config, tmp_path_factory.mktemp("mixture"))


def test_a_run_evaluates_every_game(run):
    last = read_csv(run / "eval.csv")[-1]
    assert list(last) == ["frames", "mean", "std", "n", *GAMES]
    assert [row["frames"] for row in read_csv(run / "eval.csv")] == ["256", "512"]

    final = json.loads((run / "eval.json").read_text())
    assert final["games"] == [GAMES[0]] * 4 + [GAMES[1]] * 8
    returns = np.array(final["returns"])
    assert float(last[GAMES[0]]) == pytest.approx(returns[:4].mean(), rel=1e-5)
    assert float(last[GAMES[1]]) == pytest.approx(returns[4:].mean(), rel=1e-5)

    finished = train(load(run).config, run, resume=True)  # reads the files
    assert finished.evaluation is not None
    assert list(finished.evaluation.by_game) == GAMES
    assert finished.evaluation.by_game[GAMES[1]].returns.tolist() == final["returns"][4:]


def test_an_agent_plays_its_mixture_one_of_its_games_or_another_game(run):
    agent = load(run)
    mixed = evaluate(agent, episodes=6)
    assert list(mixed.by_game) == GAMES
    assert [len(result.returns) for result in mixed.by_game.values()] == [2, 4]

    alone = evaluate(agent, episodes=4, game="SkittlesEasy")
    assert alone.by_game == {}
    assert alone.returns.shape == (4,)
    assert evaluate(agent, episodes=2, game="CountRecallEasy").returns.shape == (2,)
    assert agent.config.env == MIXTURE, "to play another game changes no agent"


def test_an_agent_of_one_game_can_be_asked_about_a_harder_one(run):
    agent = load(run)
    easy = evaluate(agent, episodes=2, game="CartPoleEasy")
    hard = evaluate(agent, episodes=2, game="CartPoleHard")
    assert easy.returns.tolist() != hard.returns.tolist()
    with pytest.raises(ValueError, match="unknown env id 'CartPoleHrd'"):
        evaluate(agent, episodes=2, game="CartPoleHrd")
    with pytest.raises(ValueError, match="game must be left out where env is given"):
        evaluate(agent, env=make_env(agent.config, 3, 0), game="CartPoleEasy")


def test_each_game_of_a_mixed_training_shows_both_twins():
    config = preset("smoke", env="+".join(GAMES), observability="mixed")
    env = make_env(config, 8, 0)
    for task in range(2):
        flags = env.observability[env.task == task]
        assert flags.tolist().count(True) == 2 and flags.tolist().count(False) == 2


def test_a_mixture_has_the_numbers_that_its_games_share():
    def numbers(env):
        return preset("small", env=env).ppo

    assert numbers("CartPoleEasy+SkittlesEasy") == numbers("SkittlesEasy")
    assert numbers("BattleShipEasy+2*AutoEncodeEasy-v0").gamma == 0.98
    assert numbers("NavigatorEasy+NavigatorHard") == numbers("NavigatorEasy")
    of_none = numbers("TetrisEasy")
    assert numbers("NavigatorEasy+CartPoleEasy") == of_none
    assert preset("paper", env="CartPoleEasy+AutoEncodeEasy").total_frames == 10_000_000
    assert preset("paper", env="CartPoleEasy+TetrisEasy").total_frames == 20_000_000
    assert preset("paper", env="AutoEncodeEasy+CartPoleEasy").pqn == preset("paper").pqn
