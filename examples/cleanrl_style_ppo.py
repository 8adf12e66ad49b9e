"""PPO in one file, as CleanRL writes it, on our Gymnasium vector environment; and Stable-Baselines3
in three lines.

Nothing here is TorchRL. ``gymnasium.make_vec`` gives one environment of N games, stepped by one
compiled call; with ``autoreset_mode="SameStep"`` no step is lost at an end, and the final frame,
whose value a truncated episode bootstraps from, stands in ``infos["final_obs"]``.

    python examples/cleanrl_style_ppo.py --frames 40000
    # returns of -0.60, then 0.90 after 16,000 frames
    python examples/cleanrl_style_ppo.py --sb3 --frames 10000
    # a greedy return of 0.85 after 10,240 frames
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical

from arcade_torch.gym import register_games

ID = "arcade_torch/SignpostEasy-v0"
register_games(
    ["SignpostEasy-v0"]
)  # a probe; the games of the benchmark are registered by `import arcade_torch`

NUM_ENVS = 32
NUM_STEPS = 20
MINIBATCHES = 4
EPOCHS = 3
LEARNING_RATE = 5e-4
GAMMA = 0.99
LAMBDA = 0.95
CLIP = 0.2
ENTROPY = 0.01
VALUE = 0.5


class Agent(nn.Module):
    """Frames uint8 [B, 128, 128, 3] to logits and value."""

    def __init__(self, num_actions: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(3, 16, 8, 4),
            nn.ReLU(),
            nn.Conv2d(16, 32, 4, 2),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, 2),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * 6 * 6, 128),
            nn.ReLU(),
        )
        self.policy = nn.Linear(128, num_actions)
        self.value = nn.Linear(128, 1)

    def forward(self, frames: Tensor) -> tuple[Categorical, Tensor]:
        """Policy, and value float [B]."""
        hidden = self.body(frames.permute(0, 3, 1, 2).float() / 255)
        return Categorical(logits=self.policy(hidden)), self.value(hidden).squeeze(-1)


def main(frames: int = 40_000) -> list[float]:
    """Train on the MDP twin of SignpostEasy.

    Args:
        frames: environment steps, in windows of 640.

    Returns:
        Mean return of the episodes that ended in each window.
    """
    torch.manual_seed(0)
    envs = gymnasium.make_vec(
        ID, num_envs=NUM_ENVS, observability="full", autoreset_mode="SameStep"
    )
    agent = Agent(envs.single_action_space.n)
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    frame, _ = envs.reset(seed=0)
    history: list[float] = []
    for window in range(frames // (NUM_ENVS * NUM_STEPS)):
        rollout, frame, finished = play(envs, agent, frame)
        add_advantages(rollout, agent, frame)
        learn(agent, optimizer, rollout)
        history.append(float(np.mean(finished)) if finished else float("nan"))
        if window % 8 == 0:
            print(f"{(window + 1) * NUM_ENVS * NUM_STEPS:>8,} frames, return {history[-1]:6.3f}")
    envs.close()
    return history


@torch.no_grad()
def play(
    envs: Any, agent: Agent, frame: np.ndarray
) -> tuple[dict[str, Tensor], np.ndarray, list[float]]:
    """Play one window from a frame on.

    Returns:
        The window, [T, N, ...] by name; the frame after it; returns of the episodes that ended.
    """
    shape = (NUM_STEPS, NUM_ENVS)
    rollout = {name: torch.zeros(shape) for name in ("log_probs", "rewards", "dones", "values")}
    rollout["actions"] = torch.zeros(shape, dtype=torch.int64)
    frame_shape = envs.single_observation_space.shape
    rollout["frames"] = torch.zeros((*shape, *frame_shape), dtype=torch.uint8)
    finished: list[float] = []
    for t in range(NUM_STEPS):
        rollout["frames"][t] = torch.from_numpy(frame)
        policy, rollout["values"][t] = agent(rollout["frames"][t])
        action = policy.sample()
        rollout["actions"][t] = action
        rollout["log_probs"][t] = policy.log_prob(action)
        frame, reward, terminated, truncated, infos = envs.step(action.numpy())
        rollout["rewards"][t] = torch.from_numpy(reward)
        rollout["dones"][t] = torch.from_numpy(terminated | truncated)
        cut = np.flatnonzero(truncated & ~terminated)
        # The episode would have gone on: its last step earns what was still to come.
        if len(cut):
            final = torch.from_numpy(np.stack(infos["final_obs"][cut]))
            rollout["rewards"][t, cut] += GAMMA * agent(final)[1]
        if "final_info" in infos:
            finished += infos["final_info"]["episode_reward"][infos["_final_info"]].tolist()
    return rollout, frame, finished


@torch.no_grad()
def add_advantages(rollout: dict[str, Tensor], agent: Agent, frame: np.ndarray) -> None:
    """Write advantages (GAE) and value targets of a window that ``frame`` follows."""
    next_value = agent(torch.from_numpy(frame))[1]
    advantage = torch.zeros(NUM_ENVS)
    rollout["advantages"] = torch.zeros(NUM_STEPS, NUM_ENVS)
    for t in reversed(range(NUM_STEPS)):
        goes_on = 1 - rollout["dones"][t]
        value = rollout["values"][t]
        delta = rollout["rewards"][t] + GAMMA * next_value * goes_on - value
        advantage = delta + GAMMA * LAMBDA * goes_on * advantage
        rollout["advantages"][t] = advantage
        next_value = value
    rollout["targets"] = rollout["advantages"] + rollout["values"]


def learn(agent: Agent, optimizer: torch.optim.Optimizer, rollout: dict[str, Tensor]) -> None:
    """Some epochs of PPO over one window, its steps shuffled."""
    steps = {name: values.flatten(0, 1) for name, values in rollout.items()}
    for _ in range(EPOCHS):
        for rows in torch.randperm(NUM_ENVS * NUM_STEPS).chunk(MINIBATCHES):
            policy, value = agent(steps["frames"][rows])
            ratio = (policy.log_prob(steps["actions"][rows]) - steps["log_probs"][rows]).exp()
            advantage = steps["advantages"][rows]
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
            gain = torch.minimum(ratio * advantage, clipped * advantage).mean()
            value_loss = (value - steps["targets"][rows]).square().mean()
            loss = VALUE * value_loss - gain - ENTROPY * policy.entropy().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def stable_baselines3(frames: int = 10_000) -> float:
    """The same with Stable-Baselines3's PPO and its own CNN; needs ``pip install
    '.[sb3]'``.

    Args:
        frames: environment steps, in windows of 640.

    Returns:
        Mean return of 20 greedy episodes.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    envs = make_vec_env(ID, n_envs=8, seed=0)
    agent = PPO(
        "CnnPolicy", envs, n_steps=80, batch_size=160, n_epochs=3, seed=0, device="cpu"
    ).learn(frames)
    score = float(evaluate_policy(agent, envs, n_eval_episodes=20)[0])
    print(f"Stable-Baselines3: greedy return {score:.3f} after {agent.num_timesteps:,} frames")
    return score


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=40_000)
    parser.add_argument("--sb3", action="store_true")
    options = parser.parse_args()
    stable_baselines3(options.frames) if options.sb3 else main(options.frames)
