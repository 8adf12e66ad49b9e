"""An ``ArcadeEnv`` that is stepped on after an end, without a reset, stays at that end."""

import pytest
import torch

import arcade_torch
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
