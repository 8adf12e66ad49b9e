"""The PQN loss against a step-by-step replay that knows nothing of windows."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torchrl.objectives import LossModule

from arcade_torch.agents.pqn import PQNConfig, PQNLoss
from arcade_torch.agents.targets import q_lambda_return
from tests.agents.fakes import ToyNetwork, replay, stream

GAMMA, LAM = 0.9, 0.7


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6), rows=st.integers(1, 4), steps=st.integers(1, 9), ends=st.floats(0, 1))
def test_targets_equal_those_of_a_step_by_step_replay(seed, rows, steps, ends):
    network, s = ToyNetwork(seed), stream(rows, steps, seed, ends)
    q, after = replay(network, s)
    target = q_lambda_return(s.reward, after, s.terminated, s.truncated, GAMMA, LAM)
    loss = PQNLoss(network, GAMMA, LAM)
    for batch in (s.sequences("all"), s.sequences("truncated"), s.stock()):
        out = loss.compute(loss.read(batch))
        torch.testing.assert_close(out.q_value, q, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(out.target, target, atol=1e-5, rtol=1e-5)
        chosen = q.gather(-1, s.action.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(out.loss.detach(), 0.5 * (chosen - target).square().mean(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("final_frames", ["none", "all"])
def test_terminal_time_limit_and_last_bootstrap_need_no_final_frame(final_frames):
    network, s = ToyNetwork(), stream(4, 10, seed=3)
    _, after = replay(network, s)
    loss = PQNLoss(network, GAMMA, LAM, time_limit="terminal", bootstrap="last")
    window = loss.read(s.sequences(final_frames))
    out = loss.compute(window)
    parts = (s.reward, after, s.terminated, s.truncated)
    target = q_lambda_return(*(x[:, :-1] for x in parts), GAMMA, LAM, "terminal")
    assert window.slot.shape[1] == 0
    assert out.chosen.shape == (4, 9)
    torch.testing.assert_close(out.target, target, atol=1e-5, rtol=1e-5)


def test_the_published_recursion_is_the_last_bootstrap_with_terminal_time_limits():
    """Spec of the published learner: G[L-1] = r + gamma (1 - d) m[L], then backwards with max Q of the next root."""
    network, s = ToyNetwork(1), stream(3, 12, seed=4)
    q, _ = replay(network, s)
    best, done = q.max(-1).values, s.terminated | s.truncated
    go = GAMMA * (~done).float()
    last = s.reward[:, -2] + go[:, -2] * best[:, -1]
    returns = [last]
    for t in range(s.action.shape[1] - 3, -1, -1):
        returns.append(s.reward[:, t] + go[:, t] * ((1 - LAM) * best[:, t + 1] + LAM * returns[-1]))
    loss = PQNLoss(network, GAMMA, LAM, time_limit="terminal", bootstrap="last")
    out = loss.compute(loss.read(s.sequences("none")))
    torch.testing.assert_close(out.target, torch.stack(returns[::-1], 1), atol=1e-5, rtol=1e-5)


def test_last_bootstrap_still_reads_final_frames_of_truncations():
    network, s = ToyNetwork(2), stream(4, 10, seed=5, end_share=0.6)
    _, after = replay(network, s)
    parts = (s.reward, after, s.terminated, s.truncated)
    loss = PQNLoss(network, GAMMA, LAM, bootstrap="last")
    out = loss.compute(loss.read(s.sequences("truncated")))
    expected = q_lambda_return(*(x[:, :-1] for x in parts), GAMMA, LAM)
    torch.testing.assert_close(out.target, expected, atol=1e-5, rtol=1e-5)


def test_rows_of_a_window_give_what_rows_of_the_batch_give():
    network, s = ToyNetwork(3), stream(6, 8, seed=8, end_share=0.12)
    loss, batch = PQNLoss(network, GAMMA, LAM), s.sequences()
    whole = loss.read(batch)
    assert len(set(whole.inserted)) > 1, "the rows must differ in their ends"
    assert any(whole.shuffled) and not whole.shuffled[0]
    target = loss.compute(whole).target
    for rows in ([0], [1], [2], [3], [4], [5], [4, 1], [5, 0, 3]):
        some = loss.compute(whole.rows(rows))
        torch.testing.assert_close(some.loss, loss(batch[rows])["loss"])
        torch.testing.assert_close(some.target, target[rows])
        assert whole.rows(rows).slot.shape[1] == max(whole.inserted[i] for i in rows)


def test_gradients_equal_those_of_a_loss_written_from_the_replay():
    """The target is a constant: only the chosen Q-values carry a gradient."""
    network, s = ToyNetwork(4).double(), stream(3, 6, seed=7)
    s.state, s.reward = s.state.double(), s.reward.double()
    _, after = replay(network, s)
    target = q_lambda_return(s.reward, after, s.terminated, s.truncated, GAMMA, LAM)
    q, _ = network(s.pixels, s.last_action, s.is_init, s.state)
    chosen = q.gather(-1, s.action.unsqueeze(-1)).squeeze(-1)
    expected = torch.autograd.grad(0.5 * (chosen - target).square().mean(), network.parameters())
    actual = torch.autograd.grad(PQNLoss(network, GAMMA, LAM)(s.sequences())["loss"], network.parameters())
    for a, e in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, e)


def test_final_frames_reach_the_targets():
    """Changing one final frame changes the target of its step, and of no step after it."""
    network, s = ToyNetwork(5), stream(1, 8, seed=8, end_share=0.0)
    s.truncated[0, 4] = s.is_init[0, 5] = True
    loss = PQNLoss(network, GAMMA, LAM)
    before = loss.compute(loss.read(s.sequences())).target
    s.final[0, 4] = 255 - s.final[0, 4]
    after = loss.compute(loss.read(s.sequences())).target
    assert (before[0, :5] != after[0, :5]).all()
    assert torch.equal(before[0, 5:], after[0, 5:])


def test_a_needed_frame_that_was_not_stored_is_an_error():
    s = stream(4, 10, seed=9)
    with pytest.raises(ValueError, match="final_frames='truncated'"):
        PQNLoss(ToyNetwork())(s.sequences("none"))


def test_a_stock_batch_in_mid_episode_without_state_is_an_error():
    s = stream(4, 10, seed=10)
    s.is_init[:, 0] = False
    with pytest.raises(ValueError, match="no recurrent state"):
        PQNLoss(ToyNetwork())(s.stock().exclude("memory"))


def test_a_stock_batch_of_whole_episodes_needs_no_state():
    network, s = ToyNetwork(), stream(4, 10, seed=11)
    s.is_init[:, 0] = True
    s.state.zero_()
    loss = PQNLoss(network, GAMMA, LAM)
    torch.testing.assert_close(loss(s.stock().exclude("memory"))["loss"], loss(s.sequences())["loss"])


def test_it_is_a_torchrl_loss_with_its_keys():
    network, s = ToyNetwork(), stream(2, 5, seed=12)
    loss = PQNLoss(network)
    out = loss(s.sequences())
    assert isinstance(loss, LossModule)
    assert set(out.keys()) == set(loss.out_keys)
    assert [k for k, v in out.items() if v.requires_grad] == ["loss"]
    batch = s.sequences().rename_key_("pixels", "picture")
    loss.set_keys(pixels="picture")
    torch.testing.assert_close(loss(batch)["loss"], out["loss"])
    assert {id(p) for p in loss.parameters()} == {id(p) for p in network.parameters()}


def test_training_on_one_window_lowers_its_loss():
    network, s = ToyNetwork(), stream(8, 10, seed=13)
    s.terminated[:] = True
    s.is_init[:, 1:] = True
    loss = PQNLoss(network)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    first = loss(s.sequences())["loss"].item()
    for _ in range(60):
        optimizer.zero_grad()
        loss(s.sequences())["loss"].backward()
        nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
        optimizer.step()
    assert loss(s.sequences())["loss"].item() < 0.7 * first


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"minibatches": 5}, "divisor of num_envs=16"),
        ({"lam": 1.5}, r"pqn.lam must be a number in \[0, 1\]; got 1.5"),
        ({"time_limit": "never"}, "'bootstrap' or 'terminal'"),
        ({"bootstrap": "first"}, "'next' or 'last'"),
        ({"bootstrap": "last", "context": 0}, "pqn.context"),
        ({"learning_rate": 0.0}, "pqn.learning_rate"),
        ({"epochs": 0}, "pqn.epochs"),
    ],
)
def test_a_config_that_cannot_work_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        PQNConfig(**change)
