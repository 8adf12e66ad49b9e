"""Rollouts of TorchRL whose steps are not what they seem: a loss with memory takes none of them in
silence.
"""

import pytest
import torch
from torchrl.envs import Compose, InitTracker, NoopResetEnv, TransformedEnv
from torchrl.modules.utils import get_primers_from_module

import arcade_torch
from arcade_torch.agents import DQNLoss, check_replay, make_policy
from arcade_torch.models import make_network


def rolled_out(*transforms, num_envs=1, **options):
    """A network, the policy it is part of, and what that did in CartPole until episodes ended."""
    torch.manual_seed(0)
    network = make_network("small", "mingru", hidden_size=8)
    policy = make_policy(network)
    env = arcade_torch.make("CartPoleEasy", num_envs=num_envs, observability="partial", seed=1)
    primer = get_primers_from_module(policy, warn=False)
    primed = TransformedEnv(env, Compose(*transforms, primer))
    return network, policy, primed.rollout(80, policy, break_when_any_done=False, **options)


@pytest.mark.filterwarnings("error:Converting a tensor")
def test_steps_in_a_reset_need_an_init_tracker_behind_them():
    network, _, batch = rolled_out(NoopResetEnv(5, random=False))
    assert batch["next", "done"].any()
    with pytest.raises(ValueError, match="InitTracker"):
        DQNLoss(network)(batch)
    network, policy, batch = rolled_out(NoopResetEnv(5, random=False), InitTracker())
    assert check_replay(policy, batch) < 1e-5
    assert DQNLoss(network)(batch)["loss"].isfinite()


def test_last_steps_that_a_rollout_repeats_are_refused():
    network, _, batch = rolled_out(num_envs=3, break_when_all_done=True)
    counts = batch["step_count"].squeeze(-1)
    assert (counts[:, -1] == counts[:, -2]).any()
    with pytest.raises(ValueError, match="break_when_all_done"):
        DQNLoss(network)(batch)
