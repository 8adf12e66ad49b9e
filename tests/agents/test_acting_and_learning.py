"""Acting and learning are one function: what the collector saw is what the loss computes, on real games."""

import pytest
import torch

import arcade_torch
from arcade_torch.agents.actor import EpsilonGreedyActor
from arcade_torch.agents.pqn import PQNLoss
from arcade_torch.agents.targets import q_lambda_return
from arcade_torch.models import memory_names
from arcade_torch.models.networks import make_network
from tests.agents.fakes import Stream, replay

ENVS, STEPS = 8, 24


@pytest.fixture(scope="module")
def env():
    return arcade_torch.make("CartPoleEasy", num_envs=ENVS, observability="partial", seed=5)


def collect(env, memory, context, windows=2, final_frames="all"):
    """The last of a few windows of random play; 24 random steps hold several episode ends."""
    torch.manual_seed(0)
    network = make_network("small", memory=memory, obs_size=128)
    actor = EpsilonGreedyActor(network, 1.0, torch.Generator().manual_seed(1), record_q=True)
    collector = arcade_torch.ArcadeCollector(
        env, actor, ENVS * STEPS, context=context, compress=network.compress, final_frames=final_frames, seed=7
    )
    for _ in range(windows):
        batch = collector.collect()
    return network, batch


@pytest.mark.parametrize("memory", memory_names())
@pytest.mark.parametrize("context", [0, 4])
def test_q_values_of_acting_and_learning_agree(env, memory, context):
    network, batch = collect(env, memory, context)
    assert batch["next", "done"][:, :-1].any(), "the window must hold episode ends"
    assert memory == "mlp" or any(v.abs().sum() > 0 for v in batch["initial_state"].values(True, True))
    out = PQNLoss(network).compute(PQNLoss(network).read(batch))
    assert (out.q_value - batch["q_value"]).abs().max() < 1e-4
    assert batch["q_value"].std() > 1e-4


@pytest.mark.parametrize("memory", [name for name in memory_names() if name != "mlp"])
def test_targets_at_truncations_equal_a_step_by_step_replay_of_the_true_frames(env, memory):
    network, batch = collect(env, memory, context=4)
    terminated, truncated = (batch["next", k].squeeze(-1) for k in ("terminated", "truncated"))
    flipped = terminated & (torch.arange(terminated.shape[1]) % 2 == 0)  # half of the ends, as if cut by a time limit
    terminated &= ~flipped
    truncated |= flipped
    assert truncated.any()
    s = Stream(
        pixels=batch["pixels"],
        final=arcade_torch.next_pixels(batch),
        action=batch["action"],
        last_action=batch["last_action"],
        is_init=batch["is_init"].squeeze(-1),
        reward=batch["next", "reward"].squeeze(-1),
        terminated=terminated,
        truncated=truncated,
        state=batch["initial_state"],
    )
    _, after = replay(network, s)
    loss = PQNLoss(network, 0.99, 0.8)
    out = loss.compute(loss.read(batch))
    expected = q_lambda_return(s.reward, after, terminated, truncated, 0.99, 0.8)
    torch.testing.assert_close(out.target, expected, atol=1e-5, rtol=1e-4)
    kept = ~terminated
    assert (out.next_value - after)[kept].abs().max() < 1e-5


def test_stock_batches_give_the_same_loss(env):
    network, batch = collect(env, "mingru", context=0)
    loss = PQNLoss(network)
    sequences = loss(batch)["loss"]
    stock = batch.select("action", "last_action", "is_init", "pixels", "initial_state").clone()
    for key in ("reward", "terminated", "truncated"):
        stock["next", key] = batch["next", key]
    stock["next", "pixels"] = arcade_torch.next_pixels(batch)
    torch.testing.assert_close(loss(stock)["loss"], sequences)
