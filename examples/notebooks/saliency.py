"""# Which pixels did the decision look at?

Signpost is a corridor with a sign and a gate. The sign shows one of four arrows; at the gate the
agent has to answer with it. On the **POMDP** twin the sign is shown in the first frame alone, on
the **MDP** twin it stays in view.

We take three agents: with a memory (LRU) on each twin, and without any on the POMDP. Then we ask
each of them, at the gate, which pixels of which past frame its action values depend on.

The agents come with the package, trained for a minute each. This takes less than half a minute.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

import arcade_torch
from arcade_torch.agents import evaluate, from_pretrained
from arcade_torch.tools import greedy_window, saliency, saliency_figure

# %%
AGENTS = {
    "LRU, POMDP": ("lru", "partial"),
    "no memory, POMDP": ("mlp", "partial"),
    "LRU, MDP": ("lru", "full"),
}
agents = {}
for name, (memory, twin) in AGENTS.items():
    agents[name] = from_pretrained(f"signpost-{twin}-{memory}")
    result = evaluate(agents[name])
    print(f"{name:18} return {result.mean:5.2f} in greedy episodes")

# %% [markdown]
# A return of 1 means: the right answer every time, without stumbling. Without memory nobody can
# expect more than 0.25.
#
# Each agent now plays one greedy episode. `saliency` differentiates every action value at the last
# decision by every pixel of every frame before it, squares, and sums over actions and colours:
#
# $$S_t[y, x] = \sum_a \sum_c \left(\frac{\partial Q(s_n, a)}{\partial o_t[y, x, c]}\right)^2$$

# %%
rows = []
shares = {}
for name, agent in agents.items():
    env = arcade_torch.make("SignpostEasy", num_envs=1, observability=AGENTS[name][1])
    window = greedy_window(agent, env, seed=1)
    found = saliency(agent, window.frames, window.last_action, window.is_init, window.state)
    rows.append((name, window.frames.numpy(), found.maps))
    shares[name] = found.shares()
figure = saliency_figure(rows)

# %% [markdown]
# Bright is what the decision depends on; each row has its own scale. Look at the first column. The
# agent with memory on the POMDP has heat there, on the arrow of the sign, although it sees the gate
# now. The agent without memory is dark everywhere but in the last frame: nothing else can reach it.
#
# The same as numbers, one bar a frame:

# %%
_, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for place, (name, share) in enumerate(shares.items()):
    at = np.arange(-len(share) + 1, 1)
    axis.bar(at + 0.27 * (place - 1), share, 0.25, label=name)
axis.set_xlabel("steps before the decision")
axis.set_ylabel("share of the squared gradient")
axis.legend()
for name, share in shares.items():
    print(f"{name:18} first frame {share[0]:6.1%}, last frame {share[-1]:6.1%}")

# %% [markdown]
# One episode is an example, not a result: `recall_density.ipynb` averages over many. From the
# command line, on any run: `arcade-torch analyze saliency RUN`.
