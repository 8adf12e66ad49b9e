"""Networks that do not write what a loss reads get one line, and never a number in its place."""

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import (
    ActorValueOperator,
    LSTMModule,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

from arcade_torch.agents import DQNLoss, PPOLoss, PQNLoss, make_actor
from tests.agents.fakes import toy_actor_critic, toy_network
from tests.agents.test_foreign_batches import ppo_batch, value

Q_LOSSES = pytest.mark.parametrize("make", [PQNLoss, DQNLoss])


def head(outputs, key):
    """A network without memory that reads what the toys read."""
    layers = nn.Sequential(nn.Flatten(-3), nn.LazyLinear(outputs))
    network = TensorDictModule(lambda pixels: layers(pixels.float()), ["pixels"], [key])
    network.register_module("layers", layers)
    network(ppo_batch())
    return network


@Q_LOSSES
@pytest.mark.parametrize("beyond", [-1, 2])
def test_an_action_that_the_network_has_no_value_for_is_refused(make, beyond):
    """Before: it got the value of an action at the next step, in silence."""
    network = toy_network(state_key=("memory", "actor"))
    batch = ppo_batch()
    batch["action"][1, 1] = network(batch[:, 0].clone())["action_value"].shape[-1] + beyond
    if beyond < 0:
        assert value(make(network), batch).isfinite()  # the last there is
        batch["action"][1, 1] = -1
    with pytest.raises(ValueError, match=r"^actions must be from 0 to \d+, the outputs of the net"):
        make(network)(batch)


def test_a_stored_value_takes_the_place_of_no_critic():
    """Before: a critic that wrote under another name was never trained, for the value in the batch
    was read.
    """
    network = toy_actor_critic()
    loss = PPOLoss(make_actor(network.actor), network.critic)
    batch = loss.value_estimator(ppo_batch())
    with pytest.raises(KeyError, match=r"does not write 'state_value', it writes \['worth'\]: nam"):
        PPOLoss(make_actor(network.actor), head(1, "worth"))(batch)
    with pytest.raises(KeyError, match="does not write 'state_value', it writes"):
        PPOLoss(make_actor(network.actor), head(1, "worth"))(ppo_batch())
    batch["prediction_error"] = torch.ones(4, 4)
    with pytest.raises(KeyError, match="prediction_error"):
        PPOLoss(make_actor(network.actor), network.critic, prediction_coeff=1.0)(batch)
    named = PPOLoss(make_actor(network.actor), head(1, "worth"))
    named.set_keys(value="worth")
    critic_loss = named(batch.set("worth", batch["state_value"]))["loss_critic"]
    gradients = torch.autograd.grad(
        critic_loss, list(named.critic_network_params.values(True, True))
    )
    assert any(bool(gradient.any()) for gradient in gradients)


@Q_LOSSES
def test_a_network_without_one_value_an_action_gets_one_line(make):
    with pytest.raises(KeyError, match=r"does not write 'action_value', it writes \['worth'\]: na"):
        make(head(5, "worth"))(ppo_batch())
    atoms = TensorDictModule(nn.Unflatten(-1, (3, 5)), ["logits"], ["action_value"])
    with pytest.raises(
        ValueError, match=r"^'action_value' of the network must be \[B, T, A\], one"
    ):
        make(TensorDictSequential(head(15, "logits"), atoms))(ppo_batch())
    with pytest.raises(TypeError, match=r"^a network must be a TensorDict module; got a Linear: T"):
        make(nn.Linear(2, 2))


def test_an_actor_that_draws_nothing_gets_one_line():
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(8, 5), ["hidden"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
    )
    both = ActorValueOperator(
        head(8, "hidden"), actor, ValueOperator(nn.Linear(8, 1), in_keys=["hidden"])
    )
    for network in (both, head(5, "logits"), nn.Linear(2, 2)):
        with pytest.raises(
            TypeError, match=r"^actor_network must be a probabilistic TensorDict mo"
        ):
            PPOLoss(network)
    batch = ppo_batch()
    loss = PPOLoss(both.get_policy_operator(), both.get_value_operator())
    assert value(loss, batch).isfinite().all()


def test_two_memories_under_one_key_are_refused():
    """Before: each read the state that the other had written, in silence."""
    first, second = toy_network(0), toy_network(1)
    actor = make_actor(toy_network(0, out_key="logits"))
    critic = toy_network(1, 1, out_key="state_value")
    message = r"^state_key must be another for each memory of the networks; got two .*'memory', 'h'"
    with pytest.raises(ValueError, match=message):
        PPOLoss(actor, critic)
    with pytest.raises(ValueError, match=message):
        PQNLoss(TensorDictSequential(first, second))
    twice = TensorDictSequential(first, first)  # one memory, and its state is one
    assert PQNLoss(twice).inputs.state_keys == [("memory", "h")]
    lstm = [LSTMModule(3, 3, in_key="x", out_key="y") for _ in range(2)]
    with pytest.raises(ValueError, match="got two with their state under 'recurrent_state_h'"):
        PQNLoss(TensorDictSequential(*lstm))


def test_a_policy_without_a_formula_of_its_entropy_gets_an_estimate():
    """``TanhNormal`` of TorchRL for one."""
    torch.manual_seed(0)
    network = head(4, "numbers")
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(0.003)  # frames are numbers up to 255
    extract = TensorDictModule(NormalParamExtractor(), ["numbers"], ["loc", "scale"])
    keys = {"in_keys": ["loc", "scale"], "return_log_prob": True}
    actor = ProbabilisticActor(
        TensorDictSequential(network, extract), distribution_class=TanhNormal, **keys
    )
    loss = PPOLoss(actor, head(1, "state_value"))
    batch = ppo_batch()
    batch["action"] = torch.rand(4, 4, 2) - 0.5
    with torch.no_grad():
        many = loss.actor_network.get_dist(batch.clone())
        wanted = -many.log_prob(many.sample((4000,))).mean()
        found = torch.stack([loss(batch)["entropy"] for _ in range(200)])
    assert abs(found.mean() - wanted) < 4 * found.std() / 200**0.5 + 0.02
    gradients = torch.autograd.grad(loss(batch)["loss_entropy"], list(network.parameters()))
    assert any(bool(gradient.any()) for gradient in gradients)
