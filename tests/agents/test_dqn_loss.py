"""The DQN loss: targets, burn-in, target network."""

import pytest
import torch

from arcade_torch.agents.dqn import DQNConfig, DQNLoss
from tests.agents.fakes import ToyNetwork, replay, stream

GAMMA = 0.9


def test_one_step_targets_equal_those_of_a_step_by_step_replay():
    network, s = ToyNetwork(), stream(4, 8, seed=1)
    q, after = replay(network, s)
    loss = DQNLoss(network, GAMMA)
    out = loss.compute(loss.read(s.sequences("truncated")))
    expected = s.reward + GAMMA * after * ~s.terminated
    torch.testing.assert_close(out.target, expected, atol=1e-5, rtol=1e-5)
    chosen = q.gather(-1, s.action.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(out.loss.detach(), 0.5 * (chosen - expected).square().mean(), atol=1e-5, rtol=1e-5)


def test_gamma_zero_predicts_rewards():
    network, s = ToyNetwork(), stream(4, 8, seed=2)
    loss = DQNLoss(network, 0.0)
    assert torch.equal(loss.compute(loss.read(s.sequences())).target, s.reward)


def test_a_target_network_gives_the_next_values_and_no_gradient():
    network, other, s = ToyNetwork(0), ToyNetwork(5), stream(3, 7, seed=3)
    _, after = replay(other, s)
    loss = DQNLoss(network, GAMMA, target_network=other)
    out = loss.compute(loss.read(s.sequences("truncated")))
    torch.testing.assert_close(out.target, s.reward + GAMMA * after * ~s.terminated, atol=1e-5, rtol=1e-5)
    out.loss.backward()
    assert all(p.grad is None for p in other.parameters()) and all(p.grad is not None for p in network.parameters())


def test_stored_targets_are_used_as_they_are_and_final_frames_are_not_read():
    network, s = ToyNetwork(), stream(3, 7, seed=4)
    loss = DQNLoss(network, GAMMA, targets="stored")
    window = loss.read(s.sequences())
    target = torch.randn(3, 7)
    out = loss.compute(window.roots().with_extras(target=target))
    q, _ = replay(network, s)
    chosen = q.gather(-1, s.action.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(out.loss.detach(), 0.5 * (chosen - target).square().mean(), atol=1e-5, rtol=1e-5)
    assert torch.equal(out.target, target)


def test_stored_and_recomputed_targets_agree_while_the_network_is_the_same():
    network, s = ToyNetwork(), stream(3, 7, seed=5)
    stored, fresh = DQNLoss(network, GAMMA, targets="stored"), DQNLoss(network, GAMMA)
    window = stored.read(s.sequences())
    target = stored.compute(window).target  # none is in the window yet: they are worked out
    later = stored.compute(window.roots().with_extras(target=target)).loss
    torch.testing.assert_close(later, fresh.compute(window).loss)


def test_burn_in_steps_are_read_but_not_trained():
    network, s = ToyNetwork(), stream(3, 8, seed=6, end_share=0.0)
    loss = DQNLoss(network, GAMMA, burn_in=3)
    out = loss.compute(loss.read(s.sequences()))
    error = 0.5 * (out.chosen - out.target)[:, 3:].square().mean()
    torch.testing.assert_close(out.loss.detach(), error)
    s.reward[:, :3] += 100.0
    assert torch.equal(loss.compute(loss.read(s.sequences())).loss, out.loss)
    s.pixels[:, 0] = 255 - s.pixels[:, 0]
    assert not torch.equal(loss.compute(loss.read(s.sequences())).loss, out.loss)


def test_the_defaults_are_those_of_the_published_code_but_for_fresh_targets():
    c = DQNConfig()
    assert (c.lam, c.batch_sequences, c.learning_starts, c.minibatches, c.epochs) == (0.0, 32, 32, 16, 4)
    assert (c.targets, c.target_every, c.burn_in, c.time_limit) == ("recompute", 0, 0, "bootstrap")
    assert c.replay_sequences == 992  # of 1,000: whole windows of 16 environments
    assert c.epsilon_at(0, 10**7) == 1.0 and c.epsilon_at(4 * 10**6, 10**7) == 0.05


@pytest.mark.parametrize("bad", [{"replay_frames": 4000}, {"replay_frames": 0}, {"learning_starts": 2000}])
def test_a_replay_without_room_is_refused(bad):
    with pytest.raises(ValueError, match=r"dqn\.replay_frames must be >= \d+"):
        DQNConfig(**bad)
