"""PPO with a memory on an environment of another suite: gymnax's MemoryChain, a sign to remember.

    pip install gymnax
    python examples/gymnax_ppo.py --memory gru

``from_jax`` steps it on the device and hands its arrays to TorchRL without a copy; the rest is
TorchRL's collector, loss and advantages, and one of our memories. Without a memory (``--memory
mlp``) the return stays at 0; with one it reaches 1.
"""

import argparse
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules import (
    ActorValueOperator,
    ProbabilisticActor,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import arcade_torch
from arcade_torch.models import MemoryModule, make_memory

NUM_ENVS = 64
NUM_STEPS = 32
EPOCHS = 4
WIDTH = 64


def make_agent(env: arcade_torch.JaxEnv, memory: str) -> ActorValueOperator:
    """Observation -> layer -> memory, then a head for the logits and one for the value."""
    size = env.observation_spec["observation"].shape[-1]
    common = TensorDictSequential(
        TensorDictModule(nn.Sequential(nn.Linear(size, WIDTH), nn.Tanh()), ["observation"], ["x"]),
        MemoryModule(make_memory(memory, WIDTH, WIDTH), in_key="x", out_key="y"),
    )
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(WIDTH, env.action_spec.space.n), ["y"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    return ActorValueOperator(common, actor, ValueOperator(nn.Linear(WIDTH, 1), in_keys=["y"]))


def main(env: Any, params: Any = None, memory: str = "gru", windows: int = 60) -> list[float]:
    """Train, in windows of 64 x 32 steps.

    Args:
        env: any environment that ``from_jax`` takes, with one observation array.
        params: its parameters.
        memory: name of a memory model.
        windows: how many.

    Returns:
        Mean return of the episodes that ended in each window.
    """
    torch.manual_seed(0)
    base = arcade_torch.from_jax(env, params, NUM_ENVS)
    agent = make_agent(base, memory)
    policy = agent.get_policy_operator()
    critic = agent.get_value_operator()
    acting = TransformedEnv(base, agent.module[0][1].make_tensordict_primer())
    frames = NUM_ENVS * NUM_STEPS
    collector = Collector(acting, policy, frames_per_batch=frames, total_frames=windows * frames)
    loss = ClipPPOLoss(policy, critic, entropy_coeff=0.01, critic_coeff=0.5)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True, shifted=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-3)
    returns = []
    for batch in collector:  # [N, T]: whole windows, each env's steps in their order
        with set_recurrent_mode(True), torch.no_grad():
            gae(batch)
        for _ in range(EPOCHS):
            for rows in torch.randperm(NUM_ENVS).split(NUM_ENVS // 4):
                losses: TensorDict = loss(batch[rows])
                optimizer.zero_grad()
                sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
        returns.append(float(batch["next", "episode_reward"][batch["next", "done"]].mean()))
        if len(returns) % 10 == 0:
            print(f"{len(returns) * frames:>8,} frames, return {returns[-1]:6.3f}")
    return returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="MemoryChain-bsuite")
    parser.add_argument("--memory", default="gru")
    import gymnax

    main(*gymnax.make(parser.parse_args().env), memory=parser.parse_args().memory)
