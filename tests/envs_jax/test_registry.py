"""The registry says clearly what it does not know."""

import pickle

import jax
import numpy as np
import pytest

from arcade_torch.envs_jax import (
    games_of,
    make,
    option_names,
    register,
    registered_ids,
    resolve_id,
)
from arcade_torch.envs_jax.registry import is_built_in
from arcade_torch.envs_jax.signpost import Signpost
from tests.own_registry import forget_games


def test_ids_are_versioned_and_sorted():
    ids = registered_ids()
    assert ids == sorted(ids)
    assert all(id.endswith("-v0") for id in ids)
    assert {
        f"{name}{level}-v0"
        for name in ("CartPole", "NoisyCartPole", "MineSweeper")
        for level in ("Easy", "Medium", "Hard")
    } <= set(ids)


def test_a_bare_name_means_the_newest_version():
    assert make("CartPoleEasy").id == make("CartPoleEasy-v0").id == "CartPoleEasy-v0"


@pytest.mark.parametrize("level", ["Easy", "Medium", "Hard"])
def test_noisy_pole_is_an_alias(level):
    assert (
        resolve_id(f"NoisyPole{level}")
        == resolve_id(f"NoisyPole{level}-v0")
        == f"NoisyCartPole{level}-v0"
    )


@pytest.mark.parametrize(
    ("wrong", "near"),
    [
        ("CartPole", "CartPole"),
        ("minesweepereasy", "MineSweeperEasy"),
        ("NoisyPoleEsy", "NoisyPoleEasy"),
    ],
)
def test_an_unknown_id_names_itself_the_nearest_and_the_list(wrong, near):
    with pytest.raises(ValueError) as error:
        make(wrong)
    assert repr(wrong) in str(error.value)
    assert near in str(error.value).replace(repr(wrong), "")
    assert "registered_ids" in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_version_names_the_newest():
    with pytest.raises(ValueError, match=r"CartPoleEasy-v7.*CartPoleEasy-v0"):
        make("CartPoleEasy-v7")


@pytest.mark.parametrize("size", [64, 128.5, "128", True, None])
def test_a_wrong_size_is_refused(size):
    with pytest.raises(ValueError, match=r"obs_size.*128, 256"):
        make("CartPoleEasy", obs_size=size)


def test_wrong_rules_and_options_are_refused():
    with pytest.raises(ValueError, match="rules is 'house', allowed: 'default', 'reference'"):
        make("CartPoleEasy", rules="house")
    with pytest.raises(TypeError, match="no option 'arow': its options are arrow"):
        make("CartPoleEasy", arow="log")
    with pytest.raises(ValueError, match="arrow is 'big', allowed: 'log', 'linear'"):
        make("CartPoleEasy", arrow="big")
    with pytest.raises(ValueError, match="mine_reward"):
        make("MineSweeperEasy", mine_reward=1.0)
    with pytest.raises(TypeError, match="env id"):
        make(3)


@pytest.mark.parametrize("wrong", ["-0.5", None, [-0.5], False])
@pytest.mark.parametrize(
    ("id", "option"), [("MineSweeperEasy", "mine_reward"), ("SkittlesEasy", "hit_reward")]
)
def test_a_penalty_that_is_no_number_is_refused(id, option, wrong):
    with pytest.raises(TypeError) as error:
        make(id, **{option: wrong})
    assert str(error.value) == f"{option} is {wrong!r}, expected a number from -1 to 0"


@pytest.mark.parametrize(
    ("id", "options"),
    [
        ("AutoEncodeEasy", {"mdp_marker": False}),
        ("BreakoutHard", {"tail": "previous", "random_start": True}),
        ("CartPoleEasy", {"arrow": "linear"}),
        ("CountRecallEasy", {"move_budget": 7}),
        ("MineSweeperEasy", {"mine_reward": -0.5}),
        ("SkittlesEasy", {"hit_reward": -1.0}),
    ],
)
def test_the_text_of_a_game_makes_it_again_with_its_options(id, options):
    game = make(id, **options)
    again = eval(repr(game), {"make": make})
    assert {name: getattr(again, name) for name in options} == options
    assert repr(again) == repr(game) != repr(make(id))


def test_the_text_of_a_game_of_ones_own_has_the_options_that_it_keeps(monkeypatch):
    class Own(Signpost):
        def __init__(self, *, id, obs_size, rules, kept=3, lost=4):
            level = Signpost.levels["SignpostEasy"]
            super().__init__(level, id=id, obs_size=obs_size, rules=rules)
            self.kept = kept

    forget_games(monkeypatch)
    register("OwnEasy-v0", Own)
    assert repr(make("OwnEasy", kept=5)) == (
        "make('OwnEasy-v0', obs_size=128, rules='default', kept=5)"
    )


def test_options_are_listed():
    assert option_names("CartPoleEasy") == ["arrow"]
    assert option_names("MineSweeperHard") == ["mine_reward"]


def test_an_id_may_name_several_games():
    assert games_of("CartPoleEasy") == ("CartPoleEasy-v0",)
    assert games_of("NoisyPoleEasy+2*TetrisEasy-v0") == (
        "NoisyCartPoleEasy-v0",
        "TetrisEasy-v0",
        "TetrisEasy-v0",
    )
    mixture = "NoisyCartPoleEasy-v0+2*TetrisEasy-v0"
    assert resolve_id("NoisyPoleEasy+2*TetrisEasy") == mixture
    assert resolve_id(mixture) == mixture
    assert resolve_id("TetrisEasy+CartPoleEasy+TetrisEasy") == "2*TetrisEasy-v0+CartPoleEasy-v0"
    assert is_built_in(mixture)
    assert option_names("CartPoleEasy+NoisyCartPoleEasy") == ["arrow"]
    assert option_names("CartPoleEasy+MineSweeperEasy") == []


def test_a_game_that_a_mixture_names_wrongly_is_told_by_its_name():
    with pytest.raises(ValueError, match="unknown env id 'TetrisEsy': did you mean 'TetrisEasy'"):
        resolve_id("CartPoleEasy+2*TetrisEsy")
    with pytest.raises(ValueError, match="unknown env id ''"):
        resolve_id("CartPoleEasy+")
    for shares in ("0", "-1", "100", "2.5"):
        with pytest.raises(ValueError, match="unknown env id"):
            resolve_id(f"CartPoleEasy+{shares}*TetrisEasy")


def test_a_mixture_is_no_game():
    with pytest.raises(ValueError, match=r"names several games, expected one: .*arcade_torch.make"):
        make("CartPoleEasy+TetrisEasy")


def test_a_mixture_with_a_game_of_ones_own_is_not_built_in(monkeypatch):
    forget_games(monkeypatch)
    register("PairsEasy-v0", lambda id, obs_size, rules: None)
    assert not is_built_in("CartPoleEasy+PairsEasy")


def test_options_of_a_game_of_ones_own_need_not_be_keyword_only(monkeypatch):
    def factory(id, obs_size, rules, pairs=3, *, suits=4, **unnamed):
        raise NotImplementedError

    forget_games(monkeypatch)
    register("PairsEasy-v0", factory)
    assert option_names("PairsEasy") == ["pairs", "suits"]


def test_registering_needs_a_version_and_a_free_name():
    with pytest.raises(ValueError, match="no version"):
        register("Mine", lambda **_: None)
    with pytest.raises(ValueError, match="registered already"):
        register("CartPoleEasy-v0", lambda **_: None)
    for id in ("My_Game-v0", "Foo-v007", "FooEasy-v0\n", "FooEasy-v\u0663"):
        with pytest.raises(ValueError, match="is no name of letters and digits with a version"):
            register(id, lambda **_: None)


def test_what_would_register_something_else_is_refused(monkeypatch):
    forget_games(monkeypatch)
    with pytest.raises(TypeError, match="id is 5, expected a string such as 'PairsEasy-v0'"):
        register(5, lambda **_: None)
    with pytest.raises(TypeError, match="factory of 'FooEasy-v0' is 'mine:Foo', expected the game"):
        register("FooEasy-v0", "mine:Foo")
    with pytest.raises(TypeError, match=r"aliases is 'Bar', expected a list: \['Bar'\]"):
        register("FooEasy-v0", lambda **_: None, "Bar")
    assert "FooEasy-v0" not in registered_ids()


def test_an_error_of_a_factory_is_told_in_one_line_with_its_options(monkeypatch):
    def factory(*, id, obs_size, rules, pay=1.0):
        raise RuntimeError(f"pay is {pay},\nwanted less")

    forget_games(monkeypatch)
    register("FooEasy-v0", factory)
    message = r"factory of FooEasy-v0 failed with {'pay': 2}, RuntimeError: pay is 2, wanted less$"
    with pytest.raises(ValueError, match=message):
        make("FooEasy", pay=2)


@pytest.mark.parametrize("taken", ["MineSweeperEasy", "MineSweeperEasy-v0", "NoisyPoleEasy"])
def test_no_name_of_a_game_can_be_given_to_another(monkeypatch, taken):
    def factory(**_):
        raise NotImplementedError

    forget_games(monkeypatch)
    before, meant = registered_ids(), resolve_id(taken)
    with pytest.raises(
        ValueError, match=f"the name '{taken}' belongs to the game '{meant[:-3]}' already"
    ):
        register("FooEasy-v0", factory, ["Foo", taken])
    with pytest.raises(ValueError, match="the name 'NoisyPoleEasy' belongs"):
        register("NoisyPoleEasy-v1", factory)
    assert registered_ids() == before and resolve_id(taken) == meant
    for version in (0, 1):
        register(f"FooEasy-v{version}", factory, ["Foo"])
    assert resolve_id("Foo") == "FooEasy-v1"


@pytest.mark.parametrize("id", [id for id in registered_ids() if "Easy" in id])
def test_a_game_goes_to_another_process(id):
    """By pickle, as workers and Ray send it; a copy draws the same."""
    game = make(id)
    copy = pickle.loads(pickle.dumps(game))
    assert repr(copy) == repr(game) and copy.max_steps == game.max_steps


def test_a_game_that_went_to_another_process_draws_the_same():
    game = make("SignpostEasy")
    copy = pickle.loads(pickle.dumps(game))
    state = game.reset(jax.random.PRNGKey(0))
    assert np.array_equal(copy.render(state, False), game.render(state, False))
