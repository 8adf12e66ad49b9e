"""One policy, three ways to run it: ``env.rollout``, TorchRL's ``Collector``,
``ArcadeCollector``.
"""

from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.utils import get_primers_from_module

import arcade_torch
from arcade_torch.agents import load, make_policy, preset, train
from arcade_torch.collector import ArcadeCollector
from arcade_torch.env import ArcadeEnv
from arcade_torch.models import make_actor_critic, make_network

ENVS, STEPS = 3, 12
OPTIONS = {"memory": "gru", "hidden_size": 16}


def ways(policy: nn.Module) -> list[TensorDictBase]:
    """The same [ENVS, STEPS] steps, run in three ways under the same seeds."""

    def env() -> ArcadeEnv:
        return arcade_torch.make("SignpostEasy", num_envs=ENVS, observability="partial", seed=3)

    def primed() -> TransformedEnv | ArcadeEnv:
        primers = get_primers_from_module(policy, warn=False)
        return env() if primers is None else TransformedEnv(env(), primers)

    frames = {"frames_per_batch": ENVS * STEPS, "total_frames": ENVS * STEPS}
    theirs = iter(Collector(primed(), policy, exploration_type=ExplorationType.RANDOM, **frames))
    ours = iter(ArcadeCollector(env(), policy, **frames))
    alone = primed()
    found = []
    for run in (
        lambda: alone.rollout(STEPS, policy, break_when_any_done=False),
        lambda: next(theirs),
        lambda: next(ours),
    ):
        torch.manual_seed(
            7
        )  # after the collectors were made: TorchRL's runs a policy once to see what it writes
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            found.append(run())
    return found


def assert_same(found: list[TensorDictBase], *keys: str) -> None:
    one, *others = found
    assert one["next", "done"].any() and one.shape == (ENVS, STEPS)
    for other in others:
        assert torch.equal(other["action"], one["action"])
        for key in keys:
            torch.testing.assert_close(other[key], one[key], rtol=0, atol=1e-6)


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_a_made_policy_acts_alike_everywhere(algorithm: str) -> None:
    if algorithm == "ppo":
        assert_same(
            ways(make_policy(make_actor_critic("small", **OPTIONS))), "action_log_prob", "logits"
        )
    else:
        assert_same(
            ways(make_policy(make_network("small", **OPTIONS), epsilon=0.3)), "action_value"
        )


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_a_loaded_agent_acts_alike_everywhere(algorithm: str, tmp_path: Path) -> None:
    config = preset("smoke", algorithm=algorithm, memory="gru", env="SignpostEasy")
    train(config, tmp_path / "run")
    agent = load(tmp_path / "run")
    assert_same(ways(agent), "action_log_prob" if algorithm == "ppo" else "action_value")
