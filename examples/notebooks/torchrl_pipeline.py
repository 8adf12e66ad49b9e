"""# In a TorchRL pipeline

The games are TorchRL environments and the memories are TensorDict modules, so everything of TorchRL
works on them. We look at what comes out of the environment, put a memory between stock parts, train
with TorchRL's PPO loss, and hand the result to the analyses of this package.

This takes about a minute on one core.
"""

# %%
import matplotlib.pyplot as plt
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import (
    ActorValueOperator,
    ProbabilisticActor,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import arcade_torch
from arcade_torch.models import MemoryModule, SmallEncoder, make_memory
from arcade_torch.tools import recall_density

FRAMES = 40_000  # of training
torch.manual_seed(0)

# %% [markdown]
# 64 games run side by side, drawn by JAX, seen by torch without a copy. `is_init` says where
# episodes begin.

# %%
env = arcade_torch.make("SignpostEasy", num_envs=64, observability="partial", seed=0)
first = env.reset()
for key in sorted(first.keys()):
    print(f"{key:14} {tuple(first[key].shape)!s:20} {first[key].dtype}")
figure, axes = plt.subplots(1, 4, figsize=(7, 1.9), layout="constrained")
for picture, axis in zip(first["pixels"], axes, strict=False):
    axis.imshow(picture.numpy())
    axis.set_axis_off()

# %% [markdown]
# Encoder, memory, heads. `MemoryModule` keeps the recurrent state in the tensordict and asks the
# collector for a primer, as TorchRL's `LSTMModule` does. Another memory is another name.

# %%
WIDTH = 128
encoder = SmallEncoder()
memory = make_memory("lru", WIDTH, WIDTH)
head = nn.Linear(WIDTH, 5)
body = TensorDictSequential(
    TensorDictModule(encoder, ["pixels"], ["features"]),
    MemoryModule(memory, in_key="features", out_key="remembered"),
)
actor = ProbabilisticActor(
    TensorDictModule(head, ["remembered"], ["logits"]),
    in_keys=["logits"],
    distribution_class=torch.distributions.Categorical,
    return_log_prob=True,
)
agent = ActorValueOperator(body, actor, ValueOperator(nn.Linear(WIDTH, 1), in_keys=["remembered"]))
policy = agent.get_policy_operator()
critic = agent.get_value_operator()

# %% [markdown]
# Whatever reads a window of steps runs in recurrent mode: advantages, and the loss. The windows
# here are cut into minibatches of whole environments, never of single steps, so that memory and
# experience stay together.

# %%
loss = ClipPPOLoss(policy, critic, entropy_coeff=0.01, critic_coeff=0.5)
gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)
slower = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, total_iters=-(-FRAMES // 1280))
collector = arcade_torch.ArcadeCollector(
    env, policy, 64 * 20, FRAMES, compress=encoder.compress, seed=0
)
returns = []
for window in collector:
    for _ in range(4):
        with set_recurrent_mode(True):
            batch = gae(
                window.exclude("state_value", ("next", "state_value"), "advantage", "value_target")
            )
            for part in batch[torch.randperm(64)].split(16):
                losses = loss(part)
                optimizer.zero_grad()
                sum(value for key, value in losses.items() if key.startswith("loss")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
    slower.step()
    returns.append(float(window["next", "episode_reward"][window["next", "done"]].mean()))
print(
    f"return of the last window {returns[-1]:.2f}; forgetting the sign, 0.25 is the most one can "
    "expect"
)

# %% [markdown]
# PPO samples its actions, so the returns here include exploration.
#
# The analyses take the policy as it is. Its outputs are logits, and recall density differentiates
# the probabilities.

# %%
density = recall_density(
    policy, arcade_torch.make("SignpostEasy", num_envs=16, observability="partial"), episodes=64
)
figure, axes = plt.subplots(1, 2, figsize=(8, 2.8), layout="constrained")
axes[0].plot([1280 * (i + 1) for i in range(len(returns))], returns)
axes[0].set(xlabel="frames", ylabel="return, exploration included")
axes[1].bar(range(5), density.mass(5), color="#2171b5")
axes[1].set_xticks(range(5), ["first", "·", "·", "·", "last"])
axes[1].set_ylabel("share of the gradient")
print(" ".join(f"{share:.1%}" for share in density.mass(5)))

# %% [markdown]
# `examples/torchrl_ppo_trainer.py` does the same through TorchRL's `PPOTrainer`,
# `examples/a2c_loop.py` with TorchRL's own collector, and both print the one number that says
# whether the memory is replayed as it was lived.
