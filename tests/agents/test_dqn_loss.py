"""What DQN adds to the loss of PQN: one-step targets, stored targets, burn-in."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.modules import GRUModule, recurrent_mode

from arcade_torch.agents import DQNConfig, DQNLoss
from arcade_torch.agents.learner import epsilon_at
from tests.agents.fakes import ACTIONS, GAMMA, WIDTH, chosen, look_into, play, stream, toy_network


def make_loss(network, **options):
    loss = DQNLoss(network, **options)
    loss.make_value_estimator(gamma=GAMMA, lmbda=0.0)
    return loss


def test_targets_are_one_step_targets_unless_told_otherwise():
    network, s = toy_network(), stream(4, 8, seed=1)
    q, after = play(network, s)
    loss = DQNLoss(network)  # gamma 0.99, lambda 0
    wanted = s.reward + 0.99 * after.amax(-1) * ~s.terminated
    torch.testing.assert_close(look_into(loss, s.sequences())[1], wanted, atol=1e-5, rtol=1e-5)
    error = 0.5 * (chosen(q, s.action) - wanted).square().mean()
    torch.testing.assert_close(loss(s.sequences())["loss"].detach(), error, atol=1e-5, rtol=1e-5)


def test_targets_stay_those_of_one_step_where_gamma_alone_is_given():
    """Before: ``make_value_estimator(gamma=...)`` took PQN's lambda of 0.95, in silence."""
    network, s = toy_network(), stream(4, 8, seed=1)
    wanted = s.reward + GAMMA * play(network, s)[1].amax(-1) * ~s.terminated
    loss = DQNLoss(network)
    for kind in ((), (None,)):
        loss.make_value_estimator(*kind, gamma=GAMMA)
        target = look_into(loss, s.sequences())[1]
        torch.testing.assert_close(target, wanted, atol=1e-5, rtol=1e-5)


def test_stored_targets_are_used_as_they_are():
    network, s = toy_network(), stream(3, 7, seed=4)
    loss, target = make_loss(network), torch.randn(3, 7)
    error = 0.5 * (chosen(play(network, s)[0], s.action) - target).square()
    found = loss(s.sequences().set("stored_target", target))["loss"]
    torch.testing.assert_close(found.detach(), error.mean(), atol=1e-5, rtol=1e-5)
    found = make_loss(network, burn_in=2)(s.sequences().set("stored_target", target))["loss"]
    torch.testing.assert_close(found.detach(), error[:, 2:].mean(), atol=1e-5, rtol=1e-5)
    lends = make_loss(network, bootstrap="last")  # the last step, which has no target
    found = lends(s.sequences().set("stored_target", target))["loss"]
    torch.testing.assert_close(found.detach(), error[:, :-1].mean(), atol=1e-5, rtol=1e-5)
    stored = look_into(loss, s.sequences())[1]  # by the same network: as if worked out now
    same = loss(s.sequences().set("stored_target", stored))["loss"]
    torch.testing.assert_close(same, loss(s.sequences())["loss"])


@pytest.mark.parametrize("ends", [0.0, 0.5])
@pytest.mark.parametrize("form", ["sequences", "stock"])
def test_burn_in_steps_are_read_but_not_trained(ends, form):
    network, s = toy_network(), stream(4, 8, seed=6, ends=ends)
    q, after = play(network, s)
    target = s.reward + GAMMA * after.amax(-1) * ~s.terminated
    loss = make_loss(network, burn_in=3)
    found = loss(getattr(s, form)())["loss"].detach()
    error = 0.5 * (chosen(q, s.action) - target)[:, 3:].square().mean()
    torch.testing.assert_close(found, error, atol=1e-5, rtol=1e-5)
    s.reward[:, :3] += 100.0
    assert torch.equal(loss(getattr(s, form)())["loss"], found)
    s.is_init[:, :4] = False
    whole = loss(getattr(s, form)())["loss"]
    s.pixels[:, 0] = 255 - s.pixels[:, 0]
    assert not torch.equal(loss(getattr(s, form)())["loss"], whole)


def test_burn_in_carries_no_gradient():
    """R2D2's; 0.1 let it through. The gradient is that of a window that begins where the burn-in
    ends.
    """
    network, s = toy_network(), stream(4, 8, seed=6, ends=0.3)
    burnt = make_loss(network, burn_in=3)
    wanted = torch.autograd.grad(
        make_loss(network)(later(network, s, 3).sequences())["loss"], list(network.parameters())
    )
    found = torch.autograd.grad(burnt(s.sequences())["loss"], list(network.parameters()))
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


def gru_of_torchrl():
    """A recurrent network without anything of ours."""
    keys = {
        "in_keys": ["flat", ("memory", "h"), "is_init"],
        "out_keys": ["remembered", ("next", "memory", "h")],
    }
    return TensorDictSequential(
        TensorDictModule(lambda pixels: pixels.flatten(-3) / 255, ["pixels"], ["flat"]),
        GRUModule(12, WIDTH, **keys),
        TensorDictModule(nn.Linear(WIDTH, ACTIONS), ["remembered"], ["action_value"]),
    )


def with_states(s, network):
    """A stock batch with a state at every step: random at the first, zeros behind it."""
    batch = s.stock()
    states = batch["memory", "h"].nan_to_num(0.0)
    batch["memory", "h"] = (
        states.unsqueeze(2) if isinstance(network, TensorDictSequential) else states
    )
    return batch


@pytest.mark.parametrize("start", [2, 3, 4])
@pytest.mark.parametrize("kind", ["sequence", "step", "collected step", "TorchRL"])
def test_nothing_of_the_episode_before_comes_through_a_burn_in(kind, start):
    """Where an episode begins among the steps of the burn-in or right behind them; where one begins
    later, it does.
    """
    network = gru_of_torchrl() if kind == "TorchRL" else toy_network(store=kind.split()[-1])
    s = stream(2, 8, seed=1, ends=0.0)
    s.is_init[:], s.is_init[:, start] = False, True
    loss, found = make_loss(network, burn_in=3), []
    for _ in range(2):
        batch = s.sequences() if kind == "collected step" else with_states(s, network)
        found.append(loss(batch)["loss"])
        before = slice(0, min(start, 3))
        s.pixels[:, before] = 255 - s.pixels[:, before]
    assert torch.equal(*found) == (start <= 3)


class BeginsWithOnes(TensorDictModuleBase):
    """A sum over the episode that begins with one, whatever is stored; nothing of ours."""

    in_keys = ["pixels", "h", "is_init"]  # noqa: RUF012
    out_keys = ["action_value", ("next", "h")]  # noqa: RUF012

    def __init__(self):
        super().__init__()
        self.read = nn.Linear(12, ACTIONS)

    def forward(self, tensordict):
        x = self.read(tensordict["pixels"].flatten(-3) / 255)
        if not recurrent_mode():
            x = x.unsqueeze(1)
        flags = tensordict["is_init"].reshape(x.shape[:2])
        h = tensordict["h"].reshape(*x.shape[:2], ACTIONS)[:, 0]
        states = []
        for t in range(x.shape[1]):
            h = torch.where(flags[:, t, None], 1.0, h) + x[:, t]
            states.append(h)
        states = torch.stack(states, 1).reshape(*tensordict.shape, ACTIONS)
        return tensordict.update({"action_value": states, "next": {"h": states}})


def test_a_burn_in_begins_an_episode_as_the_network_does_where_no_states_are_stored():
    s = stream(2, 8, seed=1, ends=0.0)
    s.is_init[:], s.is_init[:, 1] = False, True
    s.state = TensorDict({"h": torch.ones(2, ACTIONS)}, [2])
    network = BeginsWithOnes()
    found = look_into(make_loss(network, burn_in=3), s.sequences())
    whole = look_into(make_loss(network), s.sequences())
    torch.testing.assert_close(found[0], whole[0][:, 3:])


@pytest.mark.parametrize("burn_in", [0, 2])
@pytest.mark.parametrize("kind", ["step", "TorchRL"])
def test_a_slice_of_an_episode_starts_from_its_stored_state(kind, burn_in):
    """Samplers set ``is_init`` where they cut."""
    network = gru_of_torchrl() if kind == "TorchRL" else toy_network(store=kind)
    s = stream(2, 8, seed=1, ends=0.0)
    s.is_init[:], s.is_init[:, 0] = False, True
    loss, batch = make_loss(network, burn_in=burn_in), with_states(s, network)
    found = loss(batch.clone())["loss"]
    batch["memory", "h"].zero_()
    assert not torch.equal(loss(batch)["loss"], found)


@pytest.mark.parametrize("kind", ["step", "TorchRL"])
def test_a_burn_in_begins_with_the_given_state_as_a_pass_without_one_does(kind):
    """Sequences that somebody has cut: their flag at the first step does not drop the state."""
    network = gru_of_torchrl() if kind == "TorchRL" else toy_network(store=kind)
    s = stream(2, 8, seed=1, ends=0.0)
    s.is_init[:], s.is_init[:, 0] = False, True
    batch = s.sequences()
    state = torch.rand(2, WIDTH)
    state = state.unsqueeze(1) if kind == "TorchRL" else state
    batch["initial_state"] = TensorDict({"memory": {"h": state}}, [2])
    found = look_into(make_loss(network, burn_in=3), batch.clone())[0]
    whole = look_into(make_loss(network), batch.clone())[0]
    torch.testing.assert_close(found, whole[:, 3:])
    batch["initial_state"].zero_()
    assert not torch.equal(look_into(make_loss(network, burn_in=3), batch)[0], found)


@pytest.mark.parametrize("kind", ["sequence", "step", "TorchRL"])
def test_a_burn_in_of_whole_episodes_needs_no_stored_state(kind):
    network = gru_of_torchrl() if kind == "TorchRL" else toy_network(store=kind)
    s = stream(3, 8, seed=2, ends=0.3)
    s.is_init[:, 0] = True
    s.state.zero_()
    loss = make_loss(network, burn_in=3)
    wanted = loss(with_states(s, network))["loss"]
    torch.testing.assert_close(loss(s.stock().exclude("memory"))["loss"], wanted)


def test_a_burn_in_of_memories_that_store_in_two_ways_is_refused():
    towers = (
        toy_network(store="step"),
        toy_network(state_key=("memory", "other"), out_key="other", store="sequence"),
    )
    with pytest.raises(
        ValueError, match="burn_in must be 0 with memories that differ in store; got 1"
    ):
        DQNLoss(TensorDictSequential(*towers), burn_in=1)


@pytest.mark.parametrize(
    ("burn_in", "message"), [(-1, "a whole number >= 0"), (4, "less than the 4 steps of the batch")]
)
def test_a_burn_in_that_leaves_nothing_to_learn_from_gets_one_line(burn_in, message):
    with pytest.raises(ValueError, match=f"^burn_in must be {message}; got {burn_in}$"):
        DQNLoss(toy_network(), burn_in=burn_in)(stream(2, 4, seed=1).sequences())


@torch.no_grad()
def later(network, s, first):
    """The stream from a step on, with the state that acting had there."""
    part = (slice(None), slice(None, first))
    features = network.encode(s.pixels[part])
    _, state = network.remember(features, s.last_action[part], s.is_init[part], s.state["memory"])
    rest = {name: value[:, first:] for name, value in vars(s).items() if name != "state"}
    return type(s)(**rest, state=s.state.empty().set("memory", state))


def test_the_defaults_are_those_of_the_published_code_but_for_fresh_targets():
    c = DQNConfig()
    assert (c.lam, c.batch_sequences, c.learning_starts, c.minibatches, c.epochs) == (
        0.0,
        32,
        32,
        16,
        4,
    )
    assert (c.targets, c.target_every, c.burn_in, c.time_limit) == ("recompute", 0, 0, "bootstrap")
    assert c.replay_sequences == 992  # of 1,000: whole windows of 16 environments
    assert epsilon_at(c, 0, 10**7) == 1.0 and epsilon_at(c, 4 * 10**6, 10**7) == 0.05


@pytest.mark.parametrize(
    "bad", [{"replay_frames": 4000}, {"replay_frames": 0}, {"learning_starts": 2000}]
)
def test_a_replay_without_room_is_refused(bad):
    with pytest.raises(ValueError, match=r"dqn\.replay_frames must be >= \d+"):
        DQNConfig(**bad)
