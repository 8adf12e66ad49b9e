"""Stable-Baselines3's own checker, and one of its agents for a few steps."""

import warnings

import gymnasium
import pytest

from arcade_torch import registered_ids
from tests.contracts.test_gymnasium import COVER, SIZES, TWINS

pytest.importorskip("stable_baselines3", reason="needs the sb3 extra: pip install '.[sb3]'")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env


def check(id: str, obs_size: int, observability: str) -> None:
    env = gymnasium.make(f"arcade_torch/{id}", obs_size=obs_size, observability=observability)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


@pytest.mark.parametrize("observability", TWINS)
@pytest.mark.parametrize(("id", "obs_size"), COVER)
def test_stable_baselines3_s_checker_passes(id: str, obs_size: int, observability: str) -> None:
    check(id, obs_size, observability)


@pytest.mark.slow
@pytest.mark.parametrize("observability", TWINS)
@pytest.mark.parametrize("obs_size", SIZES)
@pytest.mark.parametrize("id", registered_ids())
def test_stable_baselines3_s_checker_passes_on_all_configurations(
    id: str, obs_size: int, observability: str
) -> None:
    check(id, obs_size, observability)


def test_an_agent_of_stable_baselines3_learns_from_it_for_a_few_steps() -> None:
    env = gymnasium.make("arcade_torch/MineSweeperEasy-v0")
    agent = PPO("CnnPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    agent.learn(16)
    assert agent.num_timesteps == 16
    action, _ = agent.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(int(action))
