"""The PQN loss against a step-by-step play that knows nothing of windows."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torchrl.modules import LSTMModule, QValueActor
from torchrl.objectives import LossModule, SoftUpdate, ValueEstimators

from arcade_torch.agents import DQNLoss, PQNLoss, q_lambda_return
from tests.agents.fakes import (
    GAMMA,
    LAM,
    chosen,
    lambda_return,
    look_into,
    play,
    stream,
    toy_network,
)


def make_loss(network, **options):
    loss = PQNLoss(network, **options)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LAM)
    return loss


def expected(network, s, steps=None, terminal=False):
    """Q-values and targets written out from the step-by-step play."""
    q, after = play(network, s)
    ends = s.terminated | s.truncated if terminal else s.terminated
    parts = s.reward, after.amax(-1), ends, s.cut
    return q, lambda_return(*(x[:, :steps] for x in parts), GAMMA, LAM)


@given(
    seed=st.integers(0, 10**6),
    rows=st.integers(1, 4),
    steps=st.integers(1, 9),
    ends=st.floats(0, 1),
    seams=st.sampled_from([0.0, 0.3]),
)
def test_targets_equal_those_of_a_step_by_step_play(seed, rows, steps, ends, seams):
    """At a seam (a start without an end before it) version 0.1 cut the window and not the return:
    value leaked.
    """
    network, s = toy_network(seed), stream(rows, steps, seed, ends, seams)
    wanted_q, wanted = expected(network, s)
    loss = make_loss(network)
    for batch in (s.sequences("all"), s.sequences(), s.stock()):
        q, target, _ = look_into(loss, batch)
        torch.testing.assert_close(q, wanted_q, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(target, wanted, atol=1e-5, rtol=1e-5)
        taken, out = chosen(wanted_q, s.action), loss(batch)
        means = {"q_mean": taken, "target_mean": wanted, "td_error": (taken - wanted).abs()}
        for key, each in ({"loss": 0.5 * (taken - wanted).square()} | means).items():
            torch.testing.assert_close(out[key].detach(), each.mean(), atol=1e-5, rtol=1e-5)


def test_a_seam_cuts_the_return_and_the_window():
    network, s = toy_network(), stream(1, 8, seed=8, ends=0.0)
    s.is_init[0, 5] = True
    loss = make_loss(network)
    before = look_into(loss, s.sequences())[1]
    s.reward[0, 5:] += 100.0  # of another episode
    s.pixels[0, 5:] = 255 - s.pixels[0, 5:]
    after = look_into(loss, s.sequences())[1]
    assert torch.equal(before[0, :5], after[0, :5]) and (before[0, 5:] != after[0, 5:]).all()


@pytest.mark.parametrize("final_frames", ["none", "all", "truncated"])
@pytest.mark.parametrize("bootstrap", ["next", "last"])
def test_terminal_time_limits_need_no_final_frame_but_the_windows_last(final_frames, bootstrap):
    network, s = toy_network(), stream(4, 10, seed=3)
    steps = 9 if bootstrap == "last" else 10
    _, wanted = expected(network, s, steps, terminal=True)
    loss = make_loss(network, time_limit="terminal", bootstrap=bootstrap)
    torch.testing.assert_close(
        look_into(loss, s.sequences(final_frames))[1], wanted, atol=1e-5, rtol=1e-5
    )


def test_the_published_recursion_is_the_last_bootstrap_with_terminal_time_limits():
    """Spec of the published learner: G[L-1] = r + gamma (1 - d) m[L], then backwards with max Q of
    the next root.
    """
    network, s = toy_network(1), stream(3, 12, seed=4)
    best, going = play(network, s)[0].amax(-1), GAMMA * (~(s.terminated | s.truncated)).float()
    returns = [s.reward[:, -2] + going[:, -2] * best[:, -1]]
    for t in range(s.action.shape[1] - 3, -1, -1):
        returns.append(
            s.reward[:, t] + going[:, t] * ((1 - LAM) * best[:, t + 1] + LAM * returns[-1])
        )
    loss = make_loss(network, time_limit="terminal", bootstrap="last")
    target = look_into(loss, s.sequences("none"))[1]
    torch.testing.assert_close(target, torch.stack(returns[::-1], 1), atol=1e-5, rtol=1e-5)


def test_last_bootstrap_still_reads_final_frames_of_truncations():
    network, s = toy_network(2), stream(4, 10, seed=5, ends=0.6)
    target = look_into(make_loss(network, bootstrap="last"), s.sequences())[1]
    torch.testing.assert_close(target, expected(network, s, 9)[1], atol=1e-5, rtol=1e-5)


def test_rows_of_a_prepared_window_give_what_rows_of_the_batch_give():
    network, s = toy_network(3), stream(6, 8, seed=8, ends=0.12)
    loss, batch = make_loss(network), s.sequences()
    data = loss.prepare(batch)
    assert len(set(batch["final_mask"].sum(1).tolist())) > 1, "the rows must differ in their ends"
    for rows in ([0], [4, 1], [5, 0, 3], [2, 2]):
        torch.testing.assert_close(loss(data[rows])["loss"], loss(batch[rows])["loss"])


def test_gradients_equal_those_of_a_loss_written_from_the_play():
    """The target is a constant: only the chosen Q-values carry a gradient."""
    network, s = toy_network(4).double(), stream(3, 6, seed=7)
    s.state, s.reward = s.state.double(), s.reward.double()
    _, target = expected(network, s)
    q, _ = network.remember(network.encode(s.pixels), s.last_action, s.is_init, s.state["memory"])
    error = 0.5 * (chosen(q, s.action) - target).square().mean()
    wanted = torch.autograd.grad(error, network.parameters())
    for functional in (True, False):
        loss = make_loss(network, functional=functional)
        found = torch.autograd.grad(loss(s.sequences())["loss"], list(network.parameters()))
        for one, other in zip(found, wanted, strict=True):
            torch.testing.assert_close(one, other)
        assert look_into(loss, s.sequences())[1].dtype == torch.float64


def test_a_final_frame_reaches_the_targets_up_to_its_step_and_none_behind():
    network, s = toy_network(5), stream(1, 8, seed=8, ends=0.0)
    s.truncated[0, 4] = s.is_init[0, 5] = True
    loss = make_loss(network)
    before = look_into(loss, s.sequences())[1]
    s.final[0, 4] = 255 - s.final[0, 4]
    after = look_into(loss, s.sequences())[1]
    assert (before[0, :5] != after[0, :5]).all() and torch.equal(before[0, 5:], after[0, 5:])


def test_what_a_target_needs_and_the_batch_lacks_is_named():
    s, loss = stream(4, 10, seed=9), make_loss(toy_network())
    with pytest.raises(ValueError, match="final_frames='truncated'"):
        loss(s.sequences("none"))
    s.is_init[:, 0] = False
    with pytest.raises(ValueError, match=r"neither 'initial_state' nor .*memory"):
        loss(s.stock().exclude("memory"))
    for key in ("action", "last_action", "is_init", ("next", "reward"), ("next", "terminated")):
        name = key if isinstance(key, str) else key[-1]
        with pytest.raises(KeyError, match=f"no entry .*{name}"):
            loss(s.stock().exclude(key))
    with pytest.raises(KeyError, match=r"neither 'final_pixels' nor \('next', 'pixels'\)"):
        loss(s.stock().exclude(("next", "pixels")))


def test_a_stock_batch_of_whole_episodes_needs_no_state_and_a_single_row_no_batch():
    network, s = toy_network(), stream(4, 10, seed=11)
    s.is_init[:, 0] = True
    s.state.zero_()
    loss = make_loss(network)
    wanted = loss(s.sequences())["loss"]
    torch.testing.assert_close(loss(s.stock().exclude("memory"))["loss"], wanted)
    torch.testing.assert_close(loss(s.stock()[2])["loss"], loss(s.sequences()[2:3])["loss"])


def test_it_is_a_torchrl_loss():
    network, s = toy_network(), stream(2, 5, seed=12)
    loss = make_loss(network)
    out = loss(s.stock())
    assert isinstance(loss, LossModule) and set(out.keys()) == set(loss.out_keys)
    assert [key for key, value in out.items() if value.requires_grad] == ["loss"]
    assert {id(p) for p in loss.parameters()} == {id(p) for p in network.parameters()}
    one_hot = s.stock().set("action", nn.functional.one_hot(s.action, 5))
    torch.testing.assert_close(loss(one_hot)["loss"], out["loss"])
    batch = s.stock()
    names = {
        "_".join(key) if isinstance(key, tuple) else key: batch[key]
        for key in loss.in_keys
        if key != "is_init"
    }
    torch.testing.assert_close(
        loss(is_init=batch["is_init"], **names)[0], out["loss"]
    )  # plain tensors
    total, each = (make_loss(network, reduction=how)(s.stock())["loss"] for how in ("sum", "none"))
    assert each.shape == (2, 5)
    torch.testing.assert_close(total, each.sum())
    torch.testing.assert_close(each.mean(), out["loss"])
    weight = torch.rand(2, 5)
    weighted = make_loss(network)(s.stock().set("priority_weight", weight))["loss"]
    torch.testing.assert_close(weighted, (weight * each).sum() / weight.sum())
    loss.set_keys(reward="pay")
    torch.testing.assert_close(
        loss(s.stock().rename_key_(("next", "reward"), ("next", "pay")))["loss"], out["loss"]
    )


@pytest.mark.parametrize(
    ("kind", "lam"), [(ValueEstimators.TD0, 0.0), (ValueEstimators.TDLambda, LAM)]
)
def test_torchrls_estimators_fit(kind, lam):
    network, s = toy_network(), stream(3, 8, seed=14)
    loss = PQNLoss(network)
    options = {"lmbda": lam} if kind is ValueEstimators.TDLambda else {}
    loss.make_value_estimator(kind, gamma=GAMMA, **options)
    after = play(network, s)[1].amax(-1)
    wanted = q_lambda_return(s.reward, after, s.terminated, s.cut, GAMMA, lam)
    torch.testing.assert_close(look_into(loss, s.sequences())[1], wanted, atol=1e-5, rtol=1e-5)


def test_a_stock_network_of_torchrl_is_trained_too():
    """A ``QValueActor`` behind an ``LSTMModule``: their state keys have other names, and there are
    no frames.
    """
    from tensordict.nn import TensorDictSequential

    lstm = LSTMModule(input_size=4, hidden_size=6, in_key="observation", out_key="embed")
    network = TensorDictSequential(
        lstm, QValueActor(nn.Linear(6, 5), in_keys=["embed"], action_space="categorical")
    )
    s = stream(3, 7, seed=15)
    batch = s.stock().exclude("pixels", "memory", ("next", "pixels"))
    batch["observation"], batch["next", "observation"] = torch.randn(3, 7, 4), torch.randn(3, 7, 4)
    for key in lstm.in_keys[1:3]:
        batch[key] = torch.zeros(3, 7, 1, 6)
    loss = make_loss(network)
    loss(batch)["loss"].backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in lstm.parameters())


def test_target_parameters_give_the_next_values_and_follow_slowly():
    network, other, s = toy_network(0), toy_network(5), stream(3, 7, seed=3)
    loss = make_loss(network, delay_value=True)
    updater = SoftUpdate(loss, eps=0.5)
    target = loss.target_value_network_params
    target.data.update_(type(target.data).from_module(other).data)
    _, after = play(other, s)
    wanted = lambda_return(s.reward, after.amax(-1), s.terminated, s.cut, GAMMA, LAM)
    torch.testing.assert_close(look_into(loss, s.sequences())[1], wanted, atol=1e-5, rtol=1e-5)
    before = target["head", "weight"].clone()
    loss(s.sequences())["loss"].backward()
    assert all(p.grad is not None for p in network.parameters())
    assert not any(value.requires_grad for value in target.values(True, True))
    updater.step()
    torch.testing.assert_close(target["head", "weight"], 0.5 * (before + network.head.weight))


@pytest.mark.parametrize("word", [{"time_limit": "terminate"}, {"bootstrap": "lst"}])
@pytest.mark.parametrize("kind", [PQNLoss, DQNLoss])
def test_a_misspelt_word_is_refused_when_the_loss_is_made(kind, word):
    (name, value), *_ = word.items()
    with pytest.raises(ValueError, match=f"^{name} must be '.*' or '.*'; got '{value}'$"):
        kind(toy_network(), **word)


@pytest.mark.parametrize("dtype", [torch.int8, torch.int64])
def test_rewards_may_be_whole_numbers_as_binarize_reward_gives(dtype):
    s = stream(3, 6, seed=1)
    s.reward = (s.reward > 0).float()
    assert s.reward.unique().numel() == 2
    loss = make_loss(toy_network())
    whole = s.stock()
    whole["next", "reward"] = whole["next", "reward"].to(dtype)
    assert torch.equal(loss(whole)["loss"], loss(s.stock())["loss"])


def test_training_on_one_window_lowers_its_loss():
    s, loss = stream(8, 10, seed=13), make_loss(toy_network())
    s.terminated[:] = s.is_init[:, 1:] = True
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        losses.append(loss(s.sequences())["loss"])
        losses[-1].backward()
        optimizer.step()
    assert losses[-1] < 0.7 * losses[0]
