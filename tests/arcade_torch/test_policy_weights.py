"""Random actions reach both bounds, and weights are copied whole or not at all."""

import pytest
import torch
from torch import nn
from torchrl.data import Bounded

from arcade_torch.policies import copy_weights, random_actions


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-1, 1), (3, 3)])
def test_random_whole_numbers_reach_both_bounds(low: int, high: int) -> None:
    spec = Bounded(low, high, shape=(200,), dtype=torch.int64)
    drawn = random_actions(spec, torch.Generator().manual_seed(0))
    assert set(drawn.tolist()) == set(range(low, high + 1))


def test_weights_of_another_shape_are_refused_and_nothing_is_copied() -> None:
    """Torch would repeat one number for all."""
    policy = nn.Linear(3, 2)
    before = policy.weight.detach().clone()
    with pytest.raises(ValueError, match=r"the weights have bias \[1\], which the policy does not"):
        copy_weights(policy, {"weight": torch.zeros(2, 3), "bias": torch.zeros(1)})
    assert torch.equal(policy.weight, before)


def test_weights_that_act_already_may_have_another_name() -> None:
    policy = nn.Linear(3, 2)
    copy_weights(policy, {"actor.weight": policy.weight, "bias": torch.ones(2)})
    assert torch.equal(policy.bias.detach(), torch.ones(2))
