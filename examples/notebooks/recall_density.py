"""# How far back do decisions reach?

A saliency map shows one decision. *Recall density* is the same over many episodes, without the
pixels: for each episode, how is the gradient of the last decision spread over its frames?

We look at Signpost, where the answer is known. On the POMDP twin the sign is shown in the first
frame alone, so an agent that succeeds must have brought it from there. On the MDP twin it stays in
view, and nothing has to be remembered.

The agents come with the package, trained for a minute each. This takes less than half a minute.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from arcade_torch.agents import evaluate, from_pretrained
from arcade_torch.tools import recall_density

# %%
AGENTS = {
    "LRU, POMDP": ("lru", "partial"),
    "LRU, MDP": ("lru", "full"),
    "no memory, POMDP": ("mlp", "partial"),
}
agents = {}
for name, (memory, twin) in AGENTS.items():
    agents[name] = from_pretrained(f"signpost-{twin}-{memory}")
    result = evaluate(agents[name])
    print(f"{name:18} return {result.mean:5.2f} in greedy episodes")

# %% [markdown]
# With $g_t = \sum_a \lVert \partial Q(s_n, a) / \partial o_t \rVert_1$, the density of an episode
# is $\delta_t = g_t / \sum_i g_i$: shares that sum to 1. `recall_density` plays greedy episodes on
# held-out seeds and keeps the shares of each.

# %%
found = {name: recall_density(agent, episodes=64) for name, agent in agents.items()}
for name, density in found.items():
    lengths = sorted(set(density.lengths.tolist()))
    print(f"{name:18} {len(density.shares)} episodes of {lengths[0]} to {lengths[-1]} frames")

# %% [markdown]
# Episodes have different lengths in most games, so time is cut into parts of each episode's own
# length. Here are five.

# %%
BINS = 5
figure, axes = plt.subplots(1, 3, figsize=(9, 2.9), sharey=True, layout="constrained")
for axis, (name, density) in zip(axes, found.items(), strict=True):
    axis.bar(np.arange(BINS), density.mass(BINS), color="#2171b5")
    axis.axhline(1 / BINS, color="#555555", ls=":", lw=1)
    axis.set_title(name)
    axis.set_xticks(range(BINS), ["first", *["·"] * (BINS - 2), "last"])
axes[0].set_ylabel("share of the gradient")
for name, density in found.items():
    print(f"{name:18}", " ".join(f"{share:6.1%}" for share in density.mass(BINS)))

# %% [markdown]
# * Without memory everything stands in the last part: a law, not a finding.
# * With memory on the POMDP about half of the gradient lies on the past; on the MDP, where the sign
# is still in view,
#   an eighth. The frame with the sign does not stand out from the empty corridor behind it: what
# the state carries
#   along is as sensitive to the frames on the way.
# * The dotted line is a memory that treats all frames alike. The last frame is always above it,
# because the network has
#   a way past the memory, and because the gate is seen there.
# * On the MDP a gradient on the past is not needed. What is there is what the memory mixes in all
# the same: see
#   `contamination.ipynb`.
#
# Two cautions. A gradient is what a *small* change would do: a sign that decides everything can
# have a small one. And the last action is an input too, but no pixel, so what is remembered through
# it does not show here.
#
# For whole studies: `arcade-torch analyze recall-density STUDY` (or run folders).
