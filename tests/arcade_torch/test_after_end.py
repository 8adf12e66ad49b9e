"""An env that is stepped on after an end, without a reset, stays at that end."""

import jax.numpy as jnp
import pytest
import torch
from torchrl.data import Categorical
from torchrl.envs import FrameSkipTransform, TransformedEnv

import arcade_torch
from arcade_torch import from_jax
from arcade_torch.env import ArcadeEnv

from .stub import StubGame

ENVS = 6


def steps(env, count, seed=0):
    """The ``"next"`` of random steps that heed no end."""
    generator = torch.Generator().manual_seed(seed)
    root = env.reset()
    out = []
    for _ in range(count):
        root["action"] = torch.randint(0, 5, (ENVS,), generator=generator)
        following = env.step(root)["next"].clone()
        out.append(following)
        root = following.exclude("reward").clone()
    return torch.stack(out, 1)


@pytest.mark.parametrize("id", ["own", "SkittlesEasy", "MineSweeperEasy"])
def test_frames_flags_and_counts_stay_and_nothing_is_paid(id):
    env = ArcadeEnv(StubGame(), ENVS) if id == "own" else arcade_torch.make(id, num_envs=ENVS)
    data = steps(env, 40)
    done = data["done"].squeeze(-1)
    assert done.any(1).all()
    for row, ends in zip(data, done, strict=True):
        end = int(ends.int().argmax())
        for key in ("pixels", "done", "terminated", "truncated", "step_count", "episode_reward"):
            assert (row[key][end:] == row[key][end]).all(), key
        assert (row["reward"][end + 1 :] == 0).all()
    # the last action is the one that was given, heeded or not
    assert torch.equal(env.get_state()["last_action"].long(), data["last_action"][:, -1])


@pytest.mark.parametrize("path", ["step_and_maybe_reset", "collect"])
def test_the_fused_step_begins_anew_what_a_plain_step_left_at_its_end(path):
    """Plain steps leave two of six episodes at their end; then somebody goes on by fused steps."""
    env = ArcadeEnv(StubGame(risk=0.0, max_steps=3), ENVS)
    early = torch.arange(ENVS) < 2
    root = env.reset()
    root["action"] = torch.ones(ENVS, dtype=torch.int64)
    root = env.step(root)["next"].exclude("reward").clone()
    root = env.reset(root.set("_reset", ~early.unsqueeze(-1)))
    for _ in range(2):
        root["action"] = torch.ones(ENVS, dtype=torch.int64)
        root = env.step(root)["next"].exclude("reward").clone()
    assert torch.equal(root["truncated"].squeeze(-1), early)
    if path == "collect":
        collector = arcade_torch.ArcadeCollector(env, None, frames_per_batch=ENVS * 4)
        batch = collector.collect()
        assert batch["is_init"][:2, 0].all() and (batch["step_count"][:2, 0] == 0).all()
        return
    root["action"] = torch.ones(ENVS, dtype=torch.int64)
    step, following = env.step_and_maybe_reset(root)
    assert step["next", "truncated"].all()
    assert not step["next", "reward"][early].any() and (step["next", "step_count"] == 3).all()
    assert not following["done"].any() and (following["step_count"] == 0).all()
    following["action"] = torch.ones(ENVS, dtype=torch.int64)
    assert (env.step(following)["next", "step_count"] == 1).all()


def test_a_snapshot_knows_what_has_ended_and_one_from_before_is_loaded():
    env = ArcadeEnv(StubGame(risk=0.0, max_steps=3), ENVS)
    steps(env, 4)
    ended = env.get_state()
    assert ended["truncated"].all()
    root = env.set_state(ended)
    root["action"] = torch.ones(ENVS, dtype=torch.int64)
    following = env.step(root)["next"]
    assert following["truncated"].all() and not following["reward"].any()
    older = ended.exclude("terminated", "truncated")
    root = env.set_state(older)
    root["action"] = torch.ones(ENVS, dtype=torch.int64)
    assert (env.step(root)["next", "step_count"] == 4).all()


class Passing:
    """A JAX env of somebody else that says ``done`` at its fifth step, and at no other."""

    def reset(self, key):
        return jnp.zeros(1), jnp.int32(0)

    def step(self, key, state, action):
        return jnp.ones(1) * (state + 1), state + 1, jnp.float32(1.0), state == 4, {}


@pytest.mark.parametrize("skip", [2, 3])
def test_a_frame_skip_over_an_end_of_a_jax_env_ends_the_episode(skip):
    env = from_jax(Passing(), num_envs=2, action_spec=Categorical(2, shape=(2,)))
    skipping = TransformedEnv(env, FrameSkipTransform(skip))
    data = skipping.rollout(6, break_when_any_done=False)
    steps = -(-5 // skip)  # of an episode
    ends = torch.arange(6) % steps == steps - 1
    assert torch.equal(data["next", "done"][0].squeeze(-1), ends)
    assert (data["next", "observation"][:, ends] == 5).all()
    assert (data["next", "step_count"][:, ends] == 5).all()
    assert (data["next", "reward"][:, :steps].sum(1) == 5).all()
    assert (data["next", "episode_reward"][:, ends] == 5).all()
    assert torch.equal(data["is_init"][0, 1:].squeeze(-1), ends[:-1])


def test_a_jax_env_at_its_end_waits_while_others_go_on_and_then_begins_anew():
    env = from_jax(Passing(), num_envs=2, action_spec=Categorical(2, shape=(2,)))
    action = torch.zeros(2, dtype=torch.int64)
    root = env.reset()
    for _ in range(2):
        root = env.step(root.set("action", action))["next"].exclude("reward").clone()
    root = env.reset(root.set("_reset", torch.tensor([[False], [True]])))
    for _ in range(4):
        following = env.step(root.exclude("_reset").set("action", action))["next"]
        root = following.exclude("reward").clone()
    assert root["done"].flatten().tolist() == [True, False]
    assert root["step_count"].flatten().tolist() == [5, 4]
    assert following["reward"].flatten().tolist() == [0, 1]
    step, root = env.step_and_maybe_reset(root.set("action", action))
    assert step["next", "done"].all() and (step["next", "step_count"] == 5).all()
    assert not root["done"].any() and not root["step_count"].any()
    assert not env.get_extra_state()["ends"].any()
