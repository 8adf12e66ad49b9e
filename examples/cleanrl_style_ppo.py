"""PPO in one file, as CleanRL writes it, on our Gymnasium vector environment; and Stable-Baselines3
in three lines.

Nothing here is TorchRL. ``gymnasium.make_vec`` gives one environment of N games, stepped by one
compiled call; with ``autoreset_mode="SameStep"`` no step is lost at an end, and the final frame,
whose value a truncated episode bootstraps from, stands in ``infos["final_obs"]``.

    python examples/cleanrl_style_ppo.py --frames 40000   # prints returns of -0.60, then 0.90 after
    16,000 frames python examples/cleanrl_style_ppo.py --sb3 --frames 10000   # a greedy return of
    0.85 after 10,240 frames
"""

import argparse

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

NUM_ENVS, NUM_STEPS, MINIBATCHES, EPOCHS = 32, 20, 4, 3
LEARNING_RATE, GAMMA, LAMBDA, CLIP, ENTROPY, VALUE = 5e-4, 0.99, 0.95, 0.2, 0.01, 0.5


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
        self.policy, self.value = nn.Linear(128, num_actions), nn.Linear(128, 1)

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
    shape = NUM_STEPS, NUM_ENVS
    seen = torch.zeros((*shape, *envs.single_observation_space.shape), dtype=torch.uint8)
    actions = torch.zeros(shape, dtype=torch.int64)
    log_probs, rewards, dones, values = (torch.zeros(shape) for _ in range(4))
    frame, _ = envs.reset(seed=0)
    history: list[float] = []
    for window in range(frames // (NUM_ENVS * NUM_STEPS)):
        finished: list[float] = []
        for t in range(NUM_STEPS):
            seen[t] = torch.from_numpy(frame)
            with torch.no_grad():
                policy, values[t] = agent(seen[t])
            actions[t] = policy.sample()
            log_probs[t] = policy.log_prob(actions[t])
            frame, reward, terminated, truncated, infos = envs.step(actions[t].numpy())
            rewards[t] = torch.from_numpy(reward)
            dones[t] = torch.from_numpy(terminated | truncated)
            cut = np.flatnonzero(truncated & ~terminated)
            # The episode would have gone on: its last step earns what was still to come.
            if len(cut):
                with torch.no_grad():
                    rewards[t, cut] += (
                        GAMMA * agent(torch.from_numpy(np.stack(infos["final_obs"][cut])))[1]
                    )
            if "final_info" in infos:
                finished += infos["final_info"]["episode_reward"][infos["_final_info"]].tolist()
        with torch.no_grad():
            next_value, advantage = agent(torch.from_numpy(frame))[1], torch.zeros(NUM_ENVS)
        advantages = torch.zeros(shape)
        for t in reversed(range(NUM_STEPS)):
            delta = rewards[t] + GAMMA * next_value * (1 - dones[t]) - values[t]
            advantages[t] = advantage = delta + GAMMA * LAMBDA * (1 - dones[t]) * advantage
            next_value = values[t]
        flat = [
            x.flatten(0, 1) for x in (seen, actions, log_probs, advantages, advantages + values)
        ]
        for _ in range(EPOCHS):
            for rows in torch.randperm(NUM_ENVS * NUM_STEPS).chunk(MINIBATCHES):
                f, a, old, adv, target = (x[rows] for x in flat)
                policy, value = agent(f)
                ratio = (policy.log_prob(a) - old).exp()
                adv = (adv - adv.mean()) / (adv.std() + 1e-8)
                gain = torch.minimum(ratio * adv, ratio.clamp(1 - CLIP, 1 + CLIP) * adv).mean()
                loss = (
                    VALUE * (value - target).square().mean()
                    - gain
                    - ENTROPY * policy.entropy().mean()
                )
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        history.append(float(np.mean(finished)) if finished else float("nan"))
        if window % 8 == 0:
            print(f"{(window + 1) * NUM_ENVS * NUM_STEPS:>8,} frames, return {history[-1]:6.3f}")
    envs.close()
    return history


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
