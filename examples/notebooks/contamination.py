"""# Recurrent state contamination

CartPole as an MDP shows position and motion in every frame: the past is not needed. A recurrent
agent carries a state all the same, and what once got into it may change decisions much later. We
measure how much.

One frame of a recorded episode gets noise. The agent sees the rest of the episode as it was, with
the recorded actions. Some steps later we compare its decision with the one it took without the
noise.

The agents come with the package. This takes less than half a minute.
"""

# %%
import matplotlib.pyplot as plt

from arcade_torch.agents import evaluate, from_pretrained
from arcade_torch.tools import contamination

# %%
agents = {}
for name, memory in {"LRU": "lru", "no memory": "mlp"}.items():
    agents[name] = from_pretrained(f"cartpole-full-{memory}")
    result = evaluate(agents[name], episodes=32)
    print(f"{name:10} return {result.mean:5.2f} in greedy episodes")

# %% [markdown]
# `sigmas` is the strength of the noise on pixels in [0, 1], `delays` the steps from the noisy frame
# to the decision. A delay of 0 is noise on the very frame that decides, the most that noise can do.

# %%
found = {
    name: contamination(
        agent, sigmas=(0.1, 0.3, 1.0), delays=(0, 1, 2, 5, 10, 20), starts=40, cap=64
    )
    for name, agent in agents.items()
}

# %%
figure, axes = plt.subplots(1, 3, figsize=(9, 3), sharey=True, layout="constrained")
for column, axis in enumerate(axes):
    for name, result in found.items():
        axis.plot(result.mean("flip")[column], "o-", label=name)
        axis.set_xticks(range(len(result.delays)), result.delays)
        axis.set_title(f"noise {result.sigmas[column]:g}")
    axis.set_xlabel("steps from noise to decision")
axes[0].set_ylabel("share of changed decisions")
axes[0].legend()
for name, result in found.items():
    print(f"{name:10} changed decisions by delay, noise {result.sigmas[-1]:g}:", end=" ")
    print(
        ", ".join(
            f"{k}: {share:.0%}"
            for k, share in zip(result.delays, result.mean("flip")[-1], strict=True)
        )
    )

# %% [markdown]
# * Without memory nothing changes from one step on: exactly zero, which is the control of the
# measurement.
# * With memory one noisy frame can change decisions many steps later, on a task whose every frame
# says all there is to
#   know. That is contamination.
#
# Noise takes frames out of what training has seen. `shuffle=True` permutes early frames instead,
# each of them a frame of the game. For whole studies: `arcade-torch analyze contamination RUNS
# ...`, with `--shuffle`.
