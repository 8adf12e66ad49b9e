"""Stable-Baselines3's ``RecurrentPPO`` with its own LSTM and with memories of this package.

    pip install '.[sb3]'
    python examples/sb3_memory.py --task cartpole --memory sb3_lstm lru mingru
    python examples/sb3_memory.py --task signpost --memory sb3_lstm lru

``cartpole`` is Gymnasium's CartPole without its velocities, ``signpost`` our SignpostEasy whose
sign is hidden after the first frame (without memory .25 is the most that can be expected). Prints
the mean return of the last hundred episodes for every seed, and their mean with its standard error.
"""

import argparse
import statistics
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv

from arcade_torch.gym import register_games
from arcade_torch.models import SmallEncoder
from arcade_torch.models.sb3 import CnnMemoryPolicy, MemoryPolicy

OWN = "sb3_lstm"  # the LSTM of RecurrentPPO itself; "lstm" is this package's
FRAMES = {"cartpole": 100_000, "signpost": 40_000}


class NoVelocities(gym.ObservationWrapper[np.ndarray, int, np.ndarray]):
    """CartPole's place and angle alone."""

    def __init__(self) -> None:
        super().__init__(gym.make("CartPole-v1"))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Two of the four numbers."""
        return observation[[0, 2]]


class Features(BaseFeaturesExtractor):
    """Our small encoder as Stable-Baselines3 wants one; frames arrive as [B, 3, S, S], 0..255."""

    def __init__(self, space: gym.spaces.Box) -> None:
        encoder = SmallEncoder(max(space.shape))
        super().__init__(space, encoder.feature_size)
        self.encoder = encoder

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """Features [B, 128]."""
        features: torch.Tensor = self.encoder(frames.permute(0, 2, 3, 1).to(torch.uint8))
        return features


def signpost() -> gym.Env[Any, Any]:
    """One env; probes such as this game stay out of Gymnasium's registry until they are asked
    for.
    """
    register_games(["SignpostEasy-v0"])
    return gym.make("arcade_torch/SignpostEasy-v0", observability="partial")


def make_agent(task: str, memory: str, seed: int) -> RecurrentPPO:
    """The agent and its sixteen envs."""
    settings: dict[str, Any] = {"lstm_hidden_size": 64}
    policy: Any = "MlpLstmPolicy" if memory == OWN else MemoryPolicy
    make_env: Callable[[], Any] = NoVelocities
    if task == "signpost":
        make_env = signpost
        policy = "CnnLstmPolicy" if memory == OWN else CnnMemoryPolicy
        settings["features_extractor_class"] = Features
        settings["normalize_images"] = False
    if memory != OWN:
        settings["memory"] = memory
    envs = DummyVecEnv([lambda: Monitor(make_env())] * 16)
    envs.seed(seed)
    return RecurrentPPO(
        policy,
        envs,
        n_steps=64,
        batch_size=256,
        n_epochs=4,
        learning_rate=1e-3,
        policy_kwargs=settings,
        seed=seed,
        device="cpu",
    )


def main(task: str, memory: str, frames: int, seeds: int = 3) -> list[float]:
    """Train some seeds, and return the mean return of each one's last hundred episodes."""
    returns = []
    for seed in range(seeds):
        agent = make_agent(task, memory, seed)
        agent.learn(frames)
        last = [episode["r"] for episode in agent.ep_info_buffer]
        returns.append(statistics.mean(last))
    error = statistics.stdev(returns) / len(returns) ** 0.5 if seeds > 1 else float("nan")
    values = " ".join(f"{value:.2f}" for value in returns)
    mean = statistics.mean(returns)
    print(f"{task} {memory}: {values}, mean {mean:.2f} +- {error:.2f}", flush=True)
    return returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=sorted(FRAMES), default="cartpole")
    parser.add_argument("--memory", nargs="+", default=[OWN, "lru"])
    parser.add_argument("--frames", type=int)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    for name in options.memory:
        main(options.task, name, options.frames or FRAMES[options.task], options.seeds)
