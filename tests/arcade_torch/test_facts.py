"""Facts of an env: those of its present states, as tensors that belong to nobody else."""

import pytest
import torch

import arcade_torch
from arcade_torch import ArcadeEnv

from .stub import StubGame


def test_facts_are_those_of_the_present_states() -> None:
    env = arcade_torch.make("SignpostEasy", num_envs=6, observability="partial", seed=1)
    td = env.reset()
    for _ in range(7):  # over an end, after which signs are drawn anew
        facts = env.facts()
        assert facts.batch_size == (6,) and set(facts.keys()) == {"sign"}
        assert torch.equal(facts["sign"], env.get_state()["state", "sign"])
        _, td = env.step_and_maybe_reset(td.set("action", torch.full((6,), 3)))


def test_facts_do_not_depend_on_the_twin_and_changing_them_changes_no_state() -> None:
    env = arcade_torch.make("MineSweeperEasy", num_envs=3, observability="full", seed=0)
    env.reset()
    full = env.facts()
    env.set_observability("partial")
    assert torch.equal(full["mine"], env.facts()["mine"])
    assert full["mine"].dtype is torch.bool and full["mine"].shape == (3, 4, 4)
    assert full["mine"].flatten(1).sum(1).tolist() == [2, 2, 2]
    full["mine"].fill_(False)
    full["swept"].fill_(True)
    assert env.facts()["mine"].any() and not env.facts()["swept"].any()


def test_an_ended_episode_has_the_facts_of_its_last_state() -> None:
    env = arcade_torch.make("SignpostEasy", num_envs=2, seed=3)
    td = env.reset()
    sign = env.facts()["sign"].clone()
    for _ in range(5):
        td = env.step(td.set("action", torch.full((2,), 3)))["next"]
    assert td["done"].all() and torch.equal(env.facts()["sign"], sign)


def test_a_game_without_facts_gives_none_and_a_mixture_without_a_shared_one_refuses() -> None:
    assert list(ArcadeEnv(StubGame(), num_envs=2).facts().keys()) == []
    mixed = arcade_torch.make(["SignpostEasy", "MineSweeperEasy"], num_envs=2)
    with pytest.raises(ValueError, match="no fact in common"):
        mixed.facts()
