"""Losses and the networks beside them hold the same tensors: in a copy of both, and after a move to
another type.
"""

import copy

import pytest
import torch
from torch import nn
from torchrl.objectives import SoftUpdate

from arcade_torch.agents import DQNLoss, PPOLoss, PQNLoss, make_actor
from arcade_torch.models import make_actor_critic, make_network

SMALL = {"hidden_size": 8}


def pqn():
    network = make_network("small", "mingru", **SMALL)
    return network, PQNLoss(network)


def dqn():
    network = make_network("small", "mingru", **SMALL)
    return network, DQNLoss(network, delay_value=True)


def ppo():
    network = make_actor_critic("small", "mingru", **SMALL)
    loss = PPOLoss(make_actor(network))
    loss.make_value_estimator(critic=network.critic)
    return network, loss


def two_towers():
    network = make_actor_critic("small", "mingru", towers=2, **SMALL)
    return network, PPOLoss(make_actor(network.actor), network.critic)


LOSSES = pytest.mark.parametrize("make", [pqn, dqn, ppo, two_towers])


def tensors(module):
    """Parameters and buffers with numbers in them, by where they lie."""
    values = [*module.parameters(), *module.buffers()]
    return {x.data_ptr(): x.dtype for x in values if x.numel()}


def beside(loss):
    """Networks that are no part of the loss, but read with its weights."""
    critic = getattr(loss.value_estimator, "critic", None)
    return nn.ModuleList([] if critic is None else [critic])


@LOSSES
def test_a_network_that_is_copied_with_its_loss_is_the_one_that_is_trained(make):
    agent = dict(zip(("network", "loss"), make(), strict=True))
    twin = copy.deepcopy(agent)
    assert not set(tensors(twin["loss"])) & set(tensors(agent["loss"]))
    assert set(tensors(twin["network"])) <= set(tensors(twin["loss"]))
    assert set(tensors(beside(twin["loss"]))) <= set(tensors(twin["loss"]))
    trained = [x.requires_grad for x in agent["loss"].parameters()]
    assert [x.requires_grad for x in twin["loss"].parameters()] == trained


def test_targets_of_a_copy_follow_its_own_network():
    loss = copy.deepcopy(dqn()[1])
    updater = SoftUpdate(loss, eps=0.5)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(1.0)
    updater.step()
    for key, target in loss.target_value_network_params.items(True, True):
        source = loss.value_network_params[key]
        if source.requires_grad:
            torch.testing.assert_close(source - target, torch.full_like(source, 0.5))


@LOSSES
@pytest.mark.parametrize("copied", [False, True])
def test_a_loss_that_is_moved_takes_its_networks_along(make, copied):
    network, loss = copy.deepcopy(make()) if copied else make()
    parameters = list(loss.parameters())
    loss.to(torch.float64)
    assert all(a is b for a, b in zip(parameters, loss.parameters(), strict=True))
    for module in (network, beside(loss)):
        assert set(tensors(module)) <= set(tensors(loss))
        assert torch.float32 not in tensors(module).values()
