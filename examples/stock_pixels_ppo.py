"""Feed-forward PPO for pixels from TorchRL's parts alone: one line makes our environment instead of
theirs.

    env = GymEnv("CartPole-v1", from_pixels=True, categorical_action_encoding=True)  # theirs
    env = arcade_torch.make("SignpostEasy", num_envs=32)

Everything else stays: networks (which take their sizes from the first frame), collector, buffer,
loss. Frames stay uint8 until the network, a quarter of the memory that ``ToTensorImage`` in the
environment would take.

    python examples/stock_pixels_ppo.py --frames 20000
    # prints returns of -0.58, then 0.99 after 16,000 frames
    python examples/stock_pixels_ppo.py --theirs --frames 10000
"""

import argparse
import warnings

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, GymEnv, RewardSum, TransformedEnv
from torchrl.modules import MLP, ConvNet, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import arcade_torch

WINDOW = 640
MINIBATCH = 160
EPOCHS = 3


def make_env(theirs: bool) -> EnvBase:
    """Either environment; ``reward``, ``done`` and ``pixels`` uint8 [..., height, width, 3] are the
    same in both.
    """
    if theirs:
        return GymEnv(
            "CartPole-v1", from_pixels=True, pixels_only=True, categorical_action_encoding=True
        )
    return arcade_torch.make("SignpostEasy", num_envs=32, seed=0)


class Normalise(nn.Module):
    """Frames uint8 [..., height, width, 3] to float [..., 3, height, width] in [0, 1]."""

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """See the class."""
        return pixels.movedim(-1, -3).float() / 255


def make_networks(env: EnvBase) -> tuple[ProbabilisticActor, ValueOperator]:
    """Policy and critic, with a convolutional network each."""

    def body(outputs: int) -> nn.Module:
        convolutions = ConvNet(num_cells=[16, 32, 32], kernel_sizes=[8, 4, 3], strides=[4, 2, 2])
        return nn.Sequential(Normalise(), convolutions, MLP(out_features=outputs, num_cells=[128]))

    logits = TensorDictModule(body(env.action_spec_unbatched.space.n), ["pixels"], ["logits"])
    policy = ProbabilisticActor(
        TensorDictSequential(logits),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    critic = ValueOperator(body(1), in_keys=["pixels"])
    with torch.no_grad():
        critic(policy(env.reset()))  # lazy layers learn their sizes
    return policy, critic


def main(frames: int = 20_000, theirs: bool = False) -> list[float]:
    """Train.

    Args:
        frames: environment steps, in windows of 640.
        theirs: Gymnasium's CartPole, one env, instead of the MDP twin of SignpostEasy, 32 envs.

    Returns:
        Mean return of the episodes that ended in each window (NaN where none did).
    """
    torch.manual_seed(0)
    env = TransformedEnv(make_env(theirs), RewardSum())
    policy, critic = make_networks(env)
    collector = Collector(env, policy, frames_per_batch=WINDOW, total_frames=frames)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(WINDOW), sampler=SamplerWithoutReplacement(), batch_size=MINIBATCH
    )
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(policy, critic, entropy_coeff=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)
    returns: list[float] = []
    for window, batch in enumerate(collector):
        for _ in range(EPOCHS):
            buffer.extend(
                advantage(batch.exclude("state_value", ("next", "state_value"))).reshape(-1)
            )
            for minibatch in buffer:
                losses = loss(minibatch)
                optimizer.zero_grad()
                sum(
                    losses[name] for name in ("loss_objective", "loss_critic", "loss_entropy")
                ).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
        returns.append(float(batch["next", "episode_reward"][batch["next", "done"]].mean()))
        if window % 4 == 0:
            print(f"{(window + 1) * WINDOW:>8,} frames, return {returns[-1]:6.2f}")
    collector.shutdown()
    return returns


if __name__ == "__main__":
    warnings.filterwarnings("ignore", module="torchrl")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--theirs", action="store_true")
    main(**vars(parser.parse_args()))
