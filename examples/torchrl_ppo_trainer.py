"""TorchRL's own ``PPOTrainer`` with a memory: five ways to train on garbage in silence, and how
each is closed.

1. Steps shuffled one by one: memory and experience no longer belong together. Sample slices of
   episodes.
2. A ``ReplayBuffer`` does not mark where a slice begins; a ``TensorDictReplayBuffer`` does.
3. ``GAE`` does not switch to recurrent mode by itself, losses do; and it must not find values of
   the last epoch.
4. Recurrent states need a primer: ``MemoryModule`` has one, ``ArcadeCollector`` finds it (with
   TorchRL's own collector: ``TransformedEnv(env, get_primers_from_module(policy))``).
5. ``is_init`` says where episodes begin: our environments show it, others need ``InitTracker()``.

Whether all are closed is one number, that of ``check_replay``: before the first update the replayed
log-probabilities are those of the rollout.

    python examples/torchrl_ppo_trainer.py --memory mingru --frames 60000

prints a difference of 0.0e+00 and returns of 0.83 after 21,760 frames (without memory 0.25 is the
most that can be expected), 0.98 after 32,000 and 0.99 after 52,480; 83 s of one CPU core.
"""

import argparse
import warnings
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, SliceSamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import (
    ActorValueOperator,
    ProbabilisticActor,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

import arcade_torch
from arcade_torch.agents import check_replay
from arcade_torch.models import MemoryModule, SmallEncoder, make_memory

NUM_ENVS = 64
NUM_STEPS = 20
SLICE = 5
MINIBATCH = 320
EPOCHS = 4
WIDTH = 128
OLD_VALUES = ("state_value", ("next", "state_value"), "advantage", "value_target")


class Result(NamedTuple):
    """What a run shows."""

    log_ratio: float
    """largest |log p(replayed) - log p(rollout)| in the first minibatch, before any update"""
    returns: list[float]
    """mean return of the episodes that ended in each window"""


def make_agent(memory: str, encoder: SmallEncoder) -> ActorValueOperator:
    """Frames -> encoder -> memory, then one head for the logits and one for the value."""
    common = TensorDictSequential(
        TensorDictModule(encoder, ["pixels"], ["features"]),
        MemoryModule(make_memory(memory, WIDTH, WIDTH), in_key="features", out_key="remembered"),
    )
    policy = ProbabilisticActor(
        TensorDictModule(nn.Linear(WIDTH, 5), ["remembered"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    return ActorValueOperator(
        common, policy, ValueOperator(nn.Linear(WIDTH, 1), in_keys=["remembered"])
    )


def make_trainer(memory: str, frames: int) -> PPOTrainer:
    """The trainer and its parts, all of TorchRL but environment, collector, encoder and memory."""
    encoder = SmallEncoder()
    agent = make_agent(memory, encoder)
    policy = agent.get_policy_operator()
    critic = agent.get_value_operator()
    env = arcade_torch.make("SignpostEasy", num_envs=NUM_ENVS, observability="partial", seed=0)
    collector = arcade_torch.ArcadeCollector(
        env, policy, NUM_ENVS * NUM_STEPS, frames, compress=encoder.compress, seed=0
    )
    loss = ClipPPOLoss(policy, critic, entropy_coeff=0.01, critic_coeff=0.5)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)

    def advantages(batch: TensorDictBase) -> TensorDictBase:
        with set_recurrent_mode(True):
            return gae(batch.exclude(*OLD_VALUES))

    sampler = SliceSamplerWithoutReplacement(
        slice_len=SLICE, traj_key=("collector", "traj_ids"), strict_length=False
    )
    storage = LazyTensorStorage(NUM_ENVS * NUM_STEPS)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    windows = -(-frames // (NUM_ENVS * NUM_STEPS))
    return PPOTrainer(
        collector=collector,
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=None,  # until the sampler has given every slice
        num_epochs=EPOCHS,
        loss_module=loss,
        optimizer=optimizer,
        lr_scheduler=torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, total_iters=windows),
        clip_norm=0.5,
        gae=advantages,
        replay_buffer=TensorDictReplayBuffer(
            storage=storage, sampler=sampler, batch_size=MINIBATCH
        ),
        progress_bar=False,
        seed=0,
    )


def main(frames: int = 60_000, memory: str = "mingru") -> Result:
    """Train on the POMDP twin of SignpostEasy, where forgetting the sign means at most 0.25.

    Args:
        frames: environment steps, in windows of 1,280.
        memory: name of a memory model.
    """
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the trainer calls itself experimental
        trainer = make_trainer(memory, frames)
    ratios: list[float] = []
    returns: list[float] = []

    def check(batch: TensorDictBase) -> None:
        if not ratios:
            ratios.append(check_replay(trainer.loss_module.actor_network, batch))
            print(f"replay differs from rollout by {ratios[0]:.1e} before the first update")

    def watch(batch: TensorDictBase) -> dict[str, float]:
        done = batch["next", "done"]
        returns.append(float(batch["next", "episode_reward"][done].mean()))
        if len(returns) % 8 == 1:
            print(f"{trainer.collected_frames:>8,} frames, return {returns[-1]:6.3f}")
        return {"return": returns[-1]}

    trainer.register_op("process_optim_batch", lambda batch: (check(batch), batch)[1])
    trainer.register_op("pre_steps_log", watch)
    trainer.train()
    return Result(ratios[0], returns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=60_000)
    parser.add_argument("--memory", default="mingru")
    main(**vars(parser.parse_args()))
