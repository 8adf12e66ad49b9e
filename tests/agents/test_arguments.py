"""Arguments of the public functions of the agents that their docstrings forbid: one line, and never
a result of something else in silence.
"""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from arcade_torch.agents import (
    Agent,
    DQNLoss,
    PPOLoss,
    PQNLoss,
    QLambdaEstimator,
    SequenceGAE,
    SequenceReplay,
    Trainer,
    build_network,
    evaluate,
    from_pretrained,
    gae,
    held_out_seed,
    make_actor,
    make_policy,
    paper_score,
    preset,
    q_lambda_return,
    train,
)
from arcade_torch.models import make_actor_critic, make_network

AGENT = "signpost-partial-lru"
NO_COUNTS = (0, -1, 1.5, True, None, "2", math.nan)


def one_line(message, call, *args, kind=ValueError, **options):
    """A call is refused by one line that matches."""
    with pytest.raises(kind, match=message) as refused:
        call(*args, **options)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def network():
    """A small network of Q-values."""
    return make_network("small", "mlp")


@pytest.fixture(scope="module")
def actor():
    """A small actor that writes the value too."""
    return make_actor(make_actor_critic("small", "mlp"))


@pytest.mark.parametrize(("function", "values"), [(q_lambda_return, 1), (gae, 2)])
def test_returns_are_of_tensors_with_the_types_of_their_docstring(function, values):
    ones = torch.ones(2, 4)
    no = torch.zeros(2, 4, dtype=torch.bool)
    fits = [ones, *[ones] * values, no, no, 0.9, 0.8]

    def refused(position, wrong, message):
        one_line(message, function, *fits[:position], wrong, *fits[position + 1 :])

    for position in range(values + 1):
        for wrong in (None, ones.tolist(), ones.numpy()):
            refused(position, wrong, "must be tensors")
        refused(position, ones.to(torch.complex64), "floating|float")
    for position in (values + 1, values + 2):
        for wrong in (ones, ones.long(), ones.to(torch.uint8)):
            refused(position, wrong, "must be bool")
        refused(position, None, "must be tensors")
    for position in (values + 3, values + 4):
        for wrong in (None, "0.9", True, math.nan, torch.full((2, 4), 0.5)):
            refused(position, wrong, "gamma|lam")


@pytest.mark.parametrize(("function", "values"), [(q_lambda_return, 1), (gae, 2)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16])
def test_returns_have_the_dtype_of_the_rewards(function, values, dtype):
    reward = torch.ones(2, 4, dtype=dtype)
    no = torch.zeros(2, 4, dtype=torch.bool)
    for other in (torch.float64, torch.float32, torch.float16):
        value = torch.ones(2, 4, dtype=other)
        assert function(reward, *[value] * values, no, no, 0.5, 1.0).dtype == dtype


def test_a_score_is_of_numbers_up_to_a_positive_number_of_frames():
    for wrong in (math.nan, math.inf):
        one_line("^returns must be finite", paper_score, [1, 2], [0.5, wrong])
    for wrong in (0, -1.0, math.nan, math.inf, "2", True):
        one_line("^max_frames must be", paper_score, [1, 2], [0.5, 1.0], wrong)


def test_a_seed_of_an_evaluation_is_a_whole_number():
    for wrong in (1.5, True, None, "1", math.nan):
        one_line("^seed must be", held_out_seed, wrong)
    assert held_out_seed(np.int64(3)) == held_out_seed(3)


def test_an_evaluation_is_of_whole_episodes():
    agent = from_pretrained(AGENT)
    for wrong in NO_COUNTS:
        one_line("^episodes must be a whole number", evaluate, agent, episodes=wrong)
    one_line("^seed must be", evaluate, agent, episodes=1, seed=1.5)


def test_the_exploration_of_a_policy_is_a_probability(network):
    for wrong in (-0.1, 1.5, math.nan, "0.1", None, True):
        one_line("^epsilon must be a number", make_policy, network, epsilon=wrong)
    for wrong in ("no", None, 1):
        one_line("^explore must be true or false", make_policy, network, explore=wrong)
    for wrong in (0, -1, 1.5, True):
        one_line("^num_actions must be a whole number", make_policy, network, num_actions=wrong)


def test_a_policy_is_made_of_a_network_that_writes_what_it_needs(network):
    for wrong in (None, "lru", nn.Linear(2, 3)):
        one_line("must be a TensorDict module", make_policy, wrong, kind=TypeError)
        one_line("must be a TensorDict module", make_actor, wrong, kind=TypeError)
    one_line("must write logits", make_actor, network)
    critic = make_network("small", "mlp", out_key="state_value", num_outputs=1)
    one_line("must write action_value or logits", make_policy, critic)


@pytest.mark.parametrize("loss", [PQNLoss, DQNLoss])
def test_the_options_of_a_q_loss_are_checked(loss, network):
    for wrong in ("average", None, 1):
        one_line("^reduction must be", loss, network, reduction=wrong)
    for name in ("delay_value", "functional"):
        one_line(f"^{name} must be true or false", loss, network, **{name: "no"})
    for wrong in (None, 3):
        one_line("^a network must be a TensorDict module", loss, wrong, kind=TypeError)


def test_the_options_of_a_policy_loss_are_checked(actor):
    for wrong in ("average", None, 1):
        one_line("^reduction must be", PPOLoss, actor, reduction=wrong)
    for name in ("clip_value", "normalize_advantage", "functional"):
        for wrong in ("no", 0.2):
            one_line(f"^{name} must be true or false", PPOLoss, actor, **{name: wrong})
    for wrong in (-0.2, 0.0, math.nan, "0.2"):
        one_line("^clip_epsilon must be a number", PPOLoss, actor, clip_epsilon=wrong)
    for name in ("entropy_coeff", "critic_coeff", "prediction_coeff"):
        for wrong in (math.nan, math.inf, "1", True):
            one_line(f"^{name} must be a", PPOLoss, actor, **{name: wrong})
    one_line("^advantage_norm must", PPOLoss, actor, advantage_norm=3)
    one_line("^a network must be a TensorDict module", PPOLoss, actor, 3, kind=TypeError)


def test_advantages_are_read_in_a_whole_number_of_parts(network):
    critic = make_network("small", "mlp", out_key="state_value", num_outputs=1)
    for wrong in NO_COUNTS:
        one_line("^chunks must be a whole number", SequenceGAE, critic, chunks=wrong)
    one_line("^lmbda must be", QLambdaEstimator, lmbda=1.5)


def test_a_replay_counts_in_whole_sequences(tmp_path):
    for wrong in NO_COUNTS:
        one_line("^capacity must be", SequenceReplay, wrong)
    replay = SequenceReplay(4, str(tmp_path))
    pixels = torch.zeros(4, 3, 8, 8, 3, dtype=torch.uint8)
    replay.add(TensorDict({"pixels": pixels}, [4]))
    for wrong in NO_COUNTS:
        one_line("^count must be", replay.sample, wrong, torch.Generator())
    one_line("^device is 'no_such'", replay.sample, 2, torch.Generator(), "no_such")


@pytest.mark.parametrize("wrong", [None, 3, "small", {}, object()])
def test_a_config_is_one_of_this_package(wrong, network, tmp_path):
    """An AttributeError from inside, or an agent that no measure can play."""
    made = [build_network, Trainer, lambda config: train(config, tmp_path / "run")]
    for call in (*made, lambda config: Agent(config, network)):
        one_line(r"^config must be a TrainConfig, as preset\(...\) gives; got an?", call, wrong,
                 kind=TypeError)  # fmt: skip
    assert not (tmp_path / "run").exists()


def test_a_preset_has_a_name():
    for wrong in (None, ["small"], {}, 3):
        one_line("^unknown preset", preset, wrong)


@pytest.mark.parametrize("device", ["no_such", "cuda:99", "cpu:x", ["cpu"]])
def test_a_device_that_is_not_there_is_refused(device):
    one_line("device is", from_pretrained, AGENT, device=device)
