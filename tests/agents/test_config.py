"""What a config accepts, and what the presets mean."""

import dataclasses
import json

import pytest

from arcade_torch.agents.config import TrainConfig, differing_fields, preset, preset_names
from arcade_torch.agents.pqn import PQNConfig


def test_the_defaults_are_the_papers_numbers():
    c, p = TrainConfig(), PQNConfig()
    assert (p.num_envs, p.num_steps, p.context, p.epochs, p.minibatches) == (16, 128, 4, 4, 16)
    assert (p.gamma, p.lam, p.max_grad_norm, p.warmup_steps) == (0.99, 0.95, 0.5, 132)
    assert (p.learning_rate, p.learning_rate_end, p.epsilon_start, p.epsilon_end) == (5e-5, 5e-7, 1.0, 0.05)
    assert (p.learning_rate_share * c.total_frames, p.epsilon_share * c.total_frames) == (2e6, 8e6)
    assert c.num_updates == 9_765
    assert c.num_updates * p.grad_steps_per_update == 624_960


@pytest.mark.parametrize(
    ("env", "frames", "epsilon_frames", "learning_rate_frames"),
    [
        ("CartPoleEasy", 1e7, 4e6, 1e6),
        ("NoisyCartPoleHard-v0", 1e7, 4e6, 1e6),
        ("AutoEncodeMedium", 1e7, 8e6, 2e6),
        ("MineSweeperEasy", 2e7, 8e6, 2e6),
    ],
)
def test_the_paper_preset_knows_the_budget_of_each_game(env, frames, epsilon_frames, learning_rate_frames):
    c = preset("paper", env=env)
    assert c.total_frames == frames
    assert c.pqn.epsilon_share * c.total_frames == pytest.approx(epsilon_frames)
    assert c.pqn.learning_rate_share * c.total_frames == pytest.approx(learning_rate_frames)


def test_the_reference_preset_is_the_paper_with_the_published_quirks():
    c = preset("reference", env="CartPoleEasy", seed=3)
    quirks = {"time_limit": "terminal", "bootstrap": "last"}
    changes = {"rules": "reference", "network_options": {"skip": "none"}, "pqn": quirks}
    assert c == preset("paper", env="CartPoleEasy", seed=3, **changes)


def test_the_small_preset_takes_1552_gradient_steps_in_200k_frames():
    c = preset("small")
    assert c.num_updates * c.pqn.grad_steps_per_update == 1552


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_survives_json(name):
    c = preset(name)
    assert TrainConfig.from_dict(json.loads(json.dumps(c.to_dict()))) == c


def test_a_preset_can_be_changed_down_to_its_learner():
    c = preset("small", env="SkittlesEasy", total_frames=5e4, pqn={"lam": 0.5})
    assert (c.env, c.total_frames, c.pqn.lam, c.pqn.num_envs) == ("SkittlesEasy", 50_000, 0.5, 64)
    assert c.eval_every == 10_000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"total_frames": 10}, "at least one update of 64 envs x 32 steps = 2048 frames"),
        ({"observability": "half"}, "'full' or 'partial'"),
        ({"rules": "old"}, "'default' or 'reference'"),
        ({"algorithm": "sarsa"}, "'pqn'"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**30}, "seed"),
        ({"seed": 1.5}, "seed must be a whole number; got 1.5"),
        ({"threads": -1}, "threads"),
        ({"eval_episodes": 0}, "eval_episodes"),
        ({"env": ""}, "env"),
        ({"env": 3}, "env must be a string; got 3"),
        ({"obs_size": "big"}, "obs_size must be a whole number; got 'big'"),
        ({"colour": 1}, "unknown field colour"),
        ({"pqn": {"lambda": 1}}, r"unknown field pqn\.lambda"),
        ({"pqn": {"gamma": "high"}}, r"pqn\.gamma must be a number"),
        ({"network_options": 3}, "network_options"),
    ],
)
def test_a_bad_field_gets_one_line_that_names_it(change, words):
    with pytest.raises(ValueError, match=words) as info:
        preset("small", **change)
    assert "\n" not in str(info.value)


def test_an_unknown_preset_lists_the_known_ones():
    with pytest.raises(ValueError, match="paper"):
        preset("tiny")


def test_differing_fields_are_named_but_for_those_that_do_not_matter():
    one = preset("small")
    other = dataclasses.replace(one, seed=1, threads=7, pqn=dataclasses.replace(one.pqn, lam=0.5))
    assert differing_fields(one, other) == ["pqn.lam (0.8 != 0.5)", "seed (0 != 1)"]
    assert differing_fields(one, dataclasses.replace(one, checkpoint_every=1)) == []
