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
