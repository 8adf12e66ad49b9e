"""PQN with a memory from stock TorchRL parts: its ``Collector``, our ``MemoryModule`` and
``PQNLoss``, and a loop.

The sign of SignpostEasy is shown once and asked for four steps later: without memory no more than
0.25 can be expected.

    python examples/pqn_torchrl.py --memory gru

prints returns of 0.36 after 41,472 frames, 0.91 after 61,952, and a greedy return of 1.00; 69 s of
one CPU core.
"""

import argparse

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.modules.utils import get_primers_from_module

import arcade_torch
from arcade_torch.agents import PQNLoss
from arcade_torch.models import MemoryModule, SmallEncoder, make_memory

NUM_ENVS = 32
NUM_STEPS = 16
EPOCHS = 2
MINIBATCHES = 4
WIDTH = 64


def make_env(policy: nn.Module, seed: int) -> EnvBase:
    """The POMDP twin, with the initial state of the policy's memory in every reset."""
    env = arcade_torch.make("SignpostEasy", num_envs=NUM_ENVS, observability="partial", seed=seed)
    primer = get_primers_from_module(policy, warn=False)
    return env if primer is None else TransformedEnv(env, primer)


def main(frames: int = 120_000, memory: str = "gru") -> float:
    """Train, and measure the greedy policy.

    Args:
        frames: environment steps, in windows of 512.
        memory: name of a memory model; "mlp" has none.

    Returns:
        Mean return of the greedy policy, over episodes it has not seen.
    """
    torch.manual_seed(0)
    encoder = SmallEncoder()
    greedy = TensorDictSequential(
        TensorDictModule(encoder, ["pixels"], ["features"]),
        MemoryModule(
            make_memory(memory, 128, WIDTH), in_key="features", out_key="remembered", store="step"
        ),
        TensorDictModule(nn.Linear(WIDTH, 5), ["remembered"], ["action_value"]),
        QValueModule(action_space="categorical"),
    )
    env = make_env(greedy, seed=0)
    encoder.calibrate(
        env.rollout(20, break_when_any_done=False)["pixels"]
    )  # scale frames as random play shows them
    explore = EGreedyModule(
        env.action_spec_unbatched, eps_init=1.0, eps_end=0.05, annealing_num_steps=frames // 2
    )
    policy = TensorDictSequential(*greedy, explore)

    loss = PQNLoss(greedy)  # any TensorDict module that writes "action_value" will do
    loss.make_value_estimator(gamma=0.99, lmbda=0.8)
    optimizer = torch.optim.RAdam(loss.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, 1.0, 0.05, total_iters=frames // (NUM_ENVS * NUM_STEPS)
    )

    collector = Collector(env, policy, frames_per_batch=NUM_ENVS * NUM_STEPS, total_frames=frames)
    for window, batch in enumerate(collector):  # [NUM_ENVS, NUM_STEPS]
        data = loss.prepare(batch)  # once for all minibatches; loss(batch[rows]) gives the same
        for _ in range(EPOCHS):
            for rows in torch.randperm(NUM_ENVS).chunk(MINIBATCHES):  # whole sequences, never steps
                out = loss(data[rows])
                optimizer.zero_grad()
                out["loss"].backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
        schedule.step()
        explore.step(batch.numel())
        if window % 40 == 0:
            earned = batch["next", "episode_reward"][batch["next", "done"]].mean()
            print(
                f"{(window + 1) * batch.numel():>7,} frames, return {earned:6.3f}, epsilon "
                f"{explore.eps:.2f}"
            )
    collector.shutdown()

    with torch.no_grad():
        steps = make_env(greedy, seed=1).rollout(40, greedy, break_when_any_done=False)
    result = float(steps["next", "episode_reward"][steps["next", "done"]].mean())
    print(f"greedy return {result:.2f} with {memory}")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=120_000)
    parser.add_argument("--memory", default="gru")
    main(**vars(parser.parse_args()))
