"""A reset or a step of some envs by a tensordict that holds the mask and nothing else of the root:
the other envs stay where they are, and so do their entries.
"""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical

import arcade_torch
from arcade_torch import from_jax
from tests.arcade_torch.stub import StubGame
from tests.arcade_torch.test_from_jax import Tree

N = 3
ROWS = torch.tensor([True, False, False])


def make(kind: str) -> Any:
    """An env in the middle of an episode."""
    if kind == "suite":
        env: Any = from_jax(Tree(), num_envs=N, action_spec=Categorical(2, shape=(N,)))
    else:
        env = arcade_torch.ArcadeEnv(StubGame(risk=0.0), N, state_in_td=kind == "state")
    env.step(env.rand_action(env.reset()))
    return env


KINDS = pytest.mark.parametrize("kind", ["ours", "state", "suite"])


@KINDS
def test_envs_that_are_not_reset_keep_their_entries(kind: str) -> None:
    env = make(kind)
    live = env.observe().clone()
    assert (live["step_count"] == 1).all()
    root = env.reset(TensorDict({"_reset": ROWS.unsqueeze(-1)}, [N]))
    assert torch.equal(root["step_count"].squeeze(-1) == 0, ROWS)
    assert (root[~ROWS] == live[~ROWS]).all()
    assert (env.observe() == root).all()


@KINDS
def test_envs_that_are_not_stepped_keep_their_entries(kind: str) -> None:
    env = make(kind)
    live = env.observe().clone()
    root = TensorDict({"action": torch.zeros(N, dtype=torch.int64), "_step": ROWS}, [N])
    if kind == "state":
        root["state"] = live["state"]
    following = env.step(root)["next"]
    assert torch.equal(following["step_count"].squeeze(-1) == 2, ROWS)
    assert (following.exclude("reward")[~ROWS] == live[~ROWS]).all()
    assert (following["reward"][~ROWS] == 0).all()
