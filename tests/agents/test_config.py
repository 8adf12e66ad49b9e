"""What a config accepts, and what the presets mean."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from arcade_torch.agents.config import GROUPS, OF_ENV, OF_NETWORK, DQNConfig, PQNConfig, TrainConfig
from arcade_torch.agents.differences import differing_fields
from arcade_torch.agents.learner import epsilon_at, learning_rate_at
from arcade_torch.agents.presets import preset, preset_names
from arcade_torch.envs_jax.registry import GAMES


def test_the_defaults_are_the_papers_numbers():
    c, p = TrainConfig(), PQNConfig()
    assert (p.num_envs, p.num_steps, p.overlap, p.epochs, p.minibatches) == (16, 128, 4, 4, 16)
    assert (p.gamma, p.lam, p.max_grad_norm, p.warmup_steps) == (0.99, 0.95, 0.5, 132)
    assert (p.learning_rate, p.learning_rate_end, p.epsilon_start, p.epsilon_end) == (
        5e-5,
        5e-7,
        1.0,
        0.05,
    )
    assert (p.lr_decay_fraction * c.total_frames, p.exploration_fraction * c.total_frames) == (
        2e6,
        8e6,
    )
    assert c.num_updates == 9_765
    assert c.num_updates * p.epochs * p.minibatches == 624_960


@pytest.mark.parametrize(
    ("env", "frames", "epsilon_frames", "learning_rate_frames"),
    [
        ("CartPoleEasy", 1e7, 4e6, 1e6),
        ("NoisyCartPoleHard-v0", 1e7, 4e6, 1e6),
        ("AutoEncodeMedium", 1e7, 8e6, 2e6),
        ("MineSweeperEasy", 2e7, 8e6, 2e6),
    ],
)
def test_the_paper_preset_knows_the_budget_of_each_game(
    env, frames, epsilon_frames, learning_rate_frames
):
    c = preset("paper", env=env)
    assert c.total_frames == frames
    assert c.pqn.exploration_fraction * c.total_frames == pytest.approx(epsilon_frames)
    assert c.pqn.lr_decay_fraction * c.total_frames == pytest.approx(learning_rate_frames)


def test_the_reference_preset_is_the_paper_with_the_published_quirks():
    c = preset("reference", env="CartPoleEasy", seed=3)
    quirks = {"time_limit": "terminal", "bootstrap": "last"}
    changes = {"rules": "reference", "network_options": {"skip": "none"}, "pqn": quirks}
    assert differing_fields(c, preset("paper", env="CartPoleEasy", seed=3, **changes)) == []
    ppo = preset("reference", algorithm="ppo", env="CartPoleEasy")
    assert (ppo.ppo.time_limit, ppo.network_options) == (
        "terminal",
        {"skip": "none", "use_last_action": False},
    )
    dqn = preset("reference", algorithm="dqn", env="CartPoleEasy").dqn
    assert (dqn.time_limit, dqn.targets) == ("terminal", "stored")


@pytest.mark.parametrize(("algorithm", "steps"), [("pqn", 3104), ("ppo", 1552)])
def test_gradient_steps_of_the_small_preset_in_200k_frames(algorithm, steps):
    c = preset("small", algorithm=algorithm, total_frames=200_000)
    assert c.num_updates * c.learner.grad_steps_per_update == steps


def test_the_small_preset_is_the_recipe_and_every_learner_has_numbers_in_it():
    assert (preset("small").algorithm, preset("small").memory) == ("ppo", "lru")
    assert preset("small", algorithm="pqn", pqn={"lam": 0.5}).pqn.lam == 0.5
    with pytest.raises(ValueError, match="the algorithm is 'ppo'"):
        preset("small", pqn={"lam": 0.5})


def test_the_small_presets_discount_goes_by_how_soon_an_action_is_paid():
    at_once = dict.fromkeys(("AutoEncode", "BattleShip", "CountRecall", "MineSweeper"), 0.98)
    gammas = at_once | dict.fromkeys(("CartPole", "NoisyCartPole", "Skittles"), 0.995)
    for game in GAMES:
        assert preset("small", env=f"{game}Easy").ppo.gamma == gammas.get(game, 0.99)
        assert preset("small", env=f"{game}Easy", ppo={"gamma": 0.9}).ppo.gamma == 0.9
        assert preset("small", env=f"{game}Easy", algorithm="pqn").pqn.gamma == 0.99


def test_in_the_small_preset_navigator_alone_has_limits_that_bootstrap():
    for game in GAMES:
        ppo = preset("small", env=f"{game}Easy").ppo
        search = (ppo.time_limit, ppo.entropy_coeff, ppo.prediction_coeff)
        assert (search == ("bootstrap", 0.05, 0.0)) == (game == "Navigator")
        assert preset("small", env=f"{game}Easy", algorithm="pqn").pqn.time_limit == "terminal"
    assert preset("small", env="NavigatorEasy", ppo={"entropy_coeff": 0.1}).ppo.entropy_coeff == 0.1


def test_in_the_small_preset_breakout_alone_has_a_bonus_that_begins_low():
    for game in GAMES:
        coefficient = preset("small", env=f"{game}Easy").ppo.entropy_coeff
        assert (coefficient == 0.02) == (game == "Breakout")


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_survives_json(name):
    c = preset(name)
    assert TrainConfig.from_dict(json.loads(json.dumps(c.to_dict()))) == c


def test_a_preset_can_be_changed_down_to_its_learner():
    c = preset("small", algorithm="pqn", env="SkittlesEasy", total_frames=5e4, pqn={"lam": 0.5})
    assert (c.env, c.total_frames, c.pqn.lam, c.pqn.num_envs) == ("SkittlesEasy", 50_000, 0.5, 64)
    assert c.eval_every == 10_000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"total_frames": 10}, "at least one update of 64 envs x 32 steps = 2048 frames"),
        ({"observability": "half"}, "'full', 'partial' or 'mixed'; got 'half'"),
        ({"rules": "old"}, "'default' or 'reference'"),
        ({"algorithm": "sarsa"}, "'pqn', 'ppo' or 'dqn'; got 'sarsa'"),
        ({"total_frames": float("inf")}, "total_frames must be a whole number"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**30}, "seed"),
        ({"seed": 1.5}, "seed must be a whole number; got 1.5"),
        ({"threads": -1}, "threads"),
        ({"threads": 100_000}, "threads"),  # the system has no room for them: the process aborts
        ({"eval_episodes": 0}, "eval_episodes"),
        ({"env": ""}, "env"),
        ({"env": 3}, "env must be a string; got 3"),
        ({"obs_size": "big"}, "obs_size must be a whole number; got 'big'"),
        ({"colour": 1}, "unknown field 'colour'"),
        ({"ppo": {"lambda": 1}}, r"unknown field 'ppo\.lambda'"),
        ({"ppo": {"gamma": "high"}}, r"ppo\.gamma must be a number"),
        ({"network_options": 3}, "network_options"),
        ({"total_frames": 10**30}, r"^total_frames must be at most 10\*\*15; got 1000"),
        (
            {"network_options": {"memory_options": 3}},
            r"network_options\.memory_options must be a table .*; got 3$",
        ),
        *[
            (
                {"network_options": {name: "x"}},
                rf"^network_options must be without {name}, which other fields decide",
            )
            for name in OF_NETWORK
        ],
        *[
            (
                {"env_options": {name: 1}},
                rf"^env_options must be without {name}, which other fields decide; got ",
            )
            for name in OF_ENV
        ],
        *[
            (
                {"env_options": {"noise": value}},
                r"^env_options\.noise must be a value that JSON gives back",
            )
            for value in (abs, (1, 2), {1: 2}, float("nan"), np.zeros(2), torch.zeros(2))
        ],
        ({"env_options": {1: 2}}, r"^env_options\.1 must be a value"),
        *[
            (
                {"device": device},
                r"^device must be 'cpu', 'cuda' or one of several such as 'cuda:0'; got "
                rf"{device!r}$",
            )
            for device in ("foo", "mps", "xpu:0", "cpu:x", "cuda:", "cuda:01", "cuda:1000")
        ],
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
    one = preset("small", algorithm="pqn")
    other = dataclasses.replace(one, seed=1, threads=7, pqn=dataclasses.replace(one.pqn, lam=0.5))
    assert differing_fields(one, other) == ["pqn.lam (0.8 != 0.5)", "seed (0 != 1)"]
    assert differing_fields(one, dataclasses.replace(one, checkpoint_every=1)) == []


BAD = [
    *[
        (a, f, v)
        for a in ("pqn", "ppo", "dqn")
        for f in ("num_envs", "num_steps", "epochs", "minibatches")
        for v in (0, -1)
    ],
    *[(a, "warmup_steps", -1) for a in ("pqn", "ppo", "dqn")],
    *[(a, "average_share", 1.5) for a in ("pqn", "ppo", "dqn")],
    *[
        (a, f, v)
        for a in ("pqn", "ppo", "dqn")
        for f in ("gamma", "lam", "lr_decay_fraction")
        for v in (-0.1, 1.1)
    ],
    *[
        (a, f, v)
        for a in ("pqn", "ppo", "dqn")
        for f in ("learning_rate", "max_grad_norm")
        for v in (0.0, -1.0)
    ],
    *[(a, "gamma", float("nan")) for a in ("pqn", "ppo", "dqn")],
    *[(a, "learning_rate_end", -1e-9) for a in ("pqn", "ppo", "dqn")],
    *[(a, "time_limit", "never") for a in ("pqn", "ppo", "dqn")],
    *[(a, "minibatches", 7) for a in ("pqn", "ppo", "dqn")],
    *[
        (a, f, 1.5)
        for a in ("pqn", "dqn")
        for f in ("epsilon_start", "epsilon_end", "exploration_fraction")
    ],
    *[(a, "overlap", v) for a in ("pqn", "dqn") for v in (-1, 129)],
    ("pqn", "bootstrap", "first"),
    ("ppo", "clip", 0.0),
    ("ppo", "entropy_coeff", -0.1),
    ("ppo", "entropy_end", 1.5),
    ("ppo", "advantage_decay", 1.0),
    ("ppo", "critic_coeff", -0.1),
    ("ppo", "prediction_coeff", -0.1),
    ("dqn", "batch_sequences", 0),
    ("dqn", "learning_starts", 0),
    ("dqn", "burn_in", -1),
    ("dqn", "burn_in", 132),
    ("dqn", "target_every", -1),
    ("dqn", "targets", "old"),
    ("dqn", "replay_frames", 10),
]


@pytest.mark.parametrize(("algorithm", "field", "value"), BAD)
def test_every_number_out_of_range_gets_one_line_that_names_it(algorithm, field, value):
    with pytest.raises(ValueError, match=rf"^{algorithm}\.{field} must be .*; got ") as info:
        GROUPS[algorithm](**{field: value})
    assert "\n" not in str(info.value)


def test_every_number_of_every_learner_is_tried_out_of_range():
    tried = {(algorithm, field) for algorithm, field, _ in BAD}
    assert tried == {
        (name, f.name) for name, kind in GROUPS.items() for f in dataclasses.fields(kind)
    }


def test_numbers_of_another_algorithm_are_refused_where_they_would_do_nothing():
    with pytest.raises(ValueError, match="the algorithm is 'ppo', its numbers are ppo"):
        preset("small", algorithm="ppo", pqn={"gamma": 0.5})
    assert preset("small", algorithm="ppo", ppo={"gamma": 0.0}).learner.gamma == 0.0


def test_mixed_twins_need_an_even_number_of_environments():
    with pytest.raises(ValueError, match=r"ppo\.num_envs must be even"):
        preset(
            "small", algorithm="ppo", observability="mixed", ppo={"num_envs": 3, "minibatches": 1}
        )


def test_stored_targets_and_a_target_network_exclude_each_other():
    with pytest.raises(ValueError, match=r"dqn\.target_every must be 0 with targets='stored'"):
        DQNConfig(targets="stored", target_every=10)


def test_every_preset_has_numbers_for_every_algorithm():
    for name in preset_names():
        for algorithm in GROUPS:
            config = preset(name, algorithm=algorithm)
            assert config.learner is getattr(config, algorithm) and config.num_updates >= 1


@pytest.mark.parametrize("algorithm", GROUPS)
def test_a_schedule_is_counted_in_frames(algorithm):
    numbers, total = GROUPS[algorithm](), 20_000_000
    fall = {"ppo": total}.get(algorithm, 2_000_000)
    start, end = numbers.learning_rate, numbers.learning_rate_end
    for frames in (0, fall // 2, fall, total):
        expected = end if frames >= fall else start + (end - start) * frames / fall
        assert learning_rate_at(numbers, frames, total) == pytest.approx(expected)
    if algorithm != "ppo":
        found = [epsilon_at(numbers, frames, total) for frames in (0, 4_000_000, 8_000_000, total)]
        assert found == pytest.approx([1.0, 0.525, 0.05, 0.05])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"cuda_graphs": True},
            "cuda_graphs must be false on device 'cpu'; it needs a CUDA device; got True",
        ),
        ({"amp": 1}, "amp must be true or false; got 1"),
        ({"logger": "paper"}, "logger must be 'none', 'tensorboard' or 'wandb'"),
    ],
)
def test_what_a_machine_cannot_do_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        preset("smoke", **change)
    for field in ("amp", "compile"):  # they change numbers, so they make another run
        assert differing_fields(preset("smoke"), preset("smoke", **{field: True})) == [
            f"{field} (False != True)"
        ]
    config = preset("smoke", device="cuda", cuda_graphs=True)
    assert TrainConfig.from_dict(config.to_dict()) == config


def test_options_that_json_keeps_are_taken_and_the_devices_that_games_know():
    for options in (
        {"memory_options": {"slow_gates": True}, "skip": "none"},
        {"memory_options": None, "x": [1, 2.5, ""]},
    ):
        assert preset("small", network_options=options).network_options == options
    for device in ("cpu", "cpu:0", "cuda", "cuda:0", "cuda:12"):
        assert preset("small", device=device).device == device
