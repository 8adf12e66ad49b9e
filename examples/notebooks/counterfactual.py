"""# What does a decision rest on?

A gradient says what a tiny change of a frame would do. *Counterfactual recall* makes a large one:
it exchanges a frame for that of another episode of the same agent, at the same step, lets the
memory run on, and asks whether the decision changes.

We look at Signpost, where the answer is known. On the POMDP twin the sign is shown in the first
frame alone, four steps before the gate, so the decision there must rest on that frame and on no
other. On the MDP twin it stays in view, and the decision should rest on the last frame.

The agents come with the package, trained for a minute each. This takes less than half a minute.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from arcade_torch.agents import evaluate, from_pretrained
from arcade_torch.tools import counterfactual, recall_density

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
# `counterfactual` plays greedy episodes on held-out seeds. Each has a decision, its last one, and
# is a donor for the others. Two numbers sum an agent up: *memory reliance*, how often the decision
# changes if everything before the last frame is another episode's, and *observation reliance*, how
# often it changes if the last frame is. A donor that saw the same sign cannot change anything, so
# both stand twice: over all donors, and over those whose frames truly differ.

# %%
effects = {name: counterfactual(agent, episodes=32) for name, agent in agents.items()}
for name, effect in effects.items():
    for differing, words in ((False, "all donors"), (True, "donors that differ")):
        memory = effect.memory_reliance(differing=differing)
        observation = effect.observation_reliance(differing=differing)
        print(f"{name:18} memory {memory.value:.2f}  last frame {observation.value:.2f}  {words}")

# %% [markdown]
# And by how many steps back the exchanged frame lies, beside the share of the gradient of the same
# decisions (`recall_density`, dashed).

# %%
LAGS = 5
figure, axes = plt.subplots(1, 3, figsize=(9, 2.9), sharey=True, layout="constrained")
for axis, (name, effect) in zip(axes, effects.items(), strict=True):
    # where all frames are alike an exchange changes nothing
    profile = np.nan_to_num(effect.profile("flip", differing=True)[:LAGS])
    density = recall_density(agents[name], episodes=32)
    gradient = np.mean([shares[::-1][:LAGS] for shares in density.shares], axis=0)
    axis.plot(profile, marker="o", color="#2171b5", label="decisions that change")
    axis.plot(gradient, ls="--", color="#555555", label="share of the gradient")
    axis.set_title(name)
    axis.set_xlabel("steps back")
    axis.set_ylim(-0.05, 1.05)
axes[0].legend()

# %% [markdown]
# * Without memory nothing but the last frame can change anything: a law, and the control. Here not
# even that does: at the gate all last frames of the POMDP are alike, and where frames are alike
# there is no point.
# * With memory on the POMDP the sign's frame, four steps back, changes every decision of a donor
# with another sign. The gradient puts less on it than on the last frame, which decides nothing.
# * On the MDP the last frame changes every decision. What the gradient puts on the past there
# changes none.
#
# Three cautions. Two frames that hold the same fact hide each other: exchange blocks then
# (`block=4`). A frame of another episode may be a sight that training never gave. And last actions
# stay as they were played, so what is remembered through them shows in memory reliance alone.
#
# For whole studies: `arcade-torch analyze counterfactual STUDY` (or run folders).
