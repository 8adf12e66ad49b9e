"""# Four ways to ask what a decision rests on

A *gradient* says what a tiny change of a frame would do, *integrated gradients* add up what happens
on the way from a black frame, *occlusion* covers a part of a frame, and an *exchange*
(counterfactual recall) puts the frame of another episode in its place. The first three come from
[Captum](https://captum.ai) (`pip install '.[captum]'`), which takes our agents as they are; the
last is ours.

We hold them beside each other where the answer is known: on the POMDP twin of Signpost the sign is
shown in the first frame alone, so at the gate, four steps later, the decision must rest on that
frame.

The agent comes with the package, trained for a minute. This takes less than half a minute on one
core.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch
from captum.attr import IntegratedGradients, Occlusion, Saliency

import arcade_torch
from arcade_torch.agents import evaluate, from_pretrained
from arcade_torch.tools import counterfactual, greedy_window

# %%
agent = from_pretrained("signpost-partial-lru")  # comes with the package
print(f"return {evaluate(agent).mean:.2f} in greedy episodes")

# %% [markdown]
# One greedy episode. `agent.forward_frames` goes from all its frames, [1, T, 128, 128, 3], to the
# logits of the actions at the last of them: that is what Captum attributes. The decision is the
# action that the agent took.

# %%
env = arcade_torch.make("SignpostEasy", num_envs=1, observability="partial")
window = greedy_window(agent, env, seed=1)
frames = window.frames[None].float()
context = (window.last_action[None], window.is_init.reshape(1, -1))
with torch.no_grad():
    decision = int(agent.forward_frames(frames, *context).argmax())
options = {"target": decision, "additional_forward_args": context}

# %%
patch = (1, 16, 16, 3)  # of one frame
attributions = {
    "gradient": Saliency(agent.forward_frames).attribute(
        frames.clone().requires_grad_(), **options
    ),
    "integrated gradients": IntegratedGradients(agent.forward_frames).attribute(
        frames, n_steps=16, internal_batch_size=1, **options
    ),
    "occlusion": Occlusion(agent.forward_frames).attribute(
        frames, patch, strides=patch, perturbations_per_eval=16, **options
    ),
}
maps = {}
for name, attribution in attributions.items():
    maps[name] = attribution[0].detach().abs().sum(-1).numpy()  # over colours, [T, 128, 128]

# %% [markdown]
# Where each of them looks, a row a method and a column a frame. Every row has a scale of its own,
# and brightness is the square root.

# %%
steps = frames.shape[1]
figure, axes = plt.subplots(3, steps, figsize=(1.8 * steps, 5.6), layout="constrained")
for row, (name, heat) in zip(axes, maps.items(), strict=True):
    row[0].set_ylabel(name)
    for step, axis in enumerate(row):
        axis.imshow(window.frames[step].numpy())
        bright = np.sqrt(heat[step] / max(heat.max(), 1e-30))
        axis.imshow(bright, cmap="afmhot", vmin=0, vmax=1, alpha=0.6)
        axis.set(xticks=[], yticks=[])
for step, axis in enumerate(axes[0]):
    axis.set_title(f"{steps - 1 - step} steps back")

# %% [markdown]
# And how much each puts on a frame: for the three of Captum its share of the whole, for exchanges
# the share of decisions that change if the frame is one of an episode with another sign. The last
# is an average over episodes and their donors, and needs no share: it says by itself what the frame
# does.

# %%
effects = counterfactual(agent, episodes=32)
profile = np.nan_to_num(effects.profile("flip", differing=True))  # by steps back
shares = {}
for name, heat in maps.items():
    of_frames = heat.sum((1, 2))
    shares[name] = of_frames / max(of_frames.sum(), 1e-30)
exchanged = np.zeros(steps)
count = min(steps, len(profile))
exchanged[steps - count :] = profile[:count][::-1]
shares["exchange"] = exchanged

_, axis = plt.subplots(figsize=(7.5, 3), layout="constrained")
for place, (name, share) in enumerate(shares.items()):
    axis.bar(np.arange(steps) - steps + 1 + 0.2 * (place - 1.5), share, 0.18, label=name)
axis.set_xlabel("steps before the decision")
axis.set_ylabel("share; of decisions: exchange")
axis.legend(fontsize=8)
for name, share in shares.items():
    print(f"{name:21} first frame {share[0]:6.1%}, last frame {share[-1]:6.1%}")

# %% [markdown]
# * The exchange gives the answer: the first frame changes the decision, no other does.
# * The gradient is spread over frames that decide nothing: it says how the logits would move, not
# whether another action would become the best.
# * Integrated gradients and occlusion make larger changes, but against a sight that the game never
# gives, a black frame or a black patch. What they put on later frames is what the logit of the
# action owes to seeing a corridor at all, in whatever episode.
#
# None of the four is wrong: they answer different questions. To ask what a *memory* does, exchange
# something that the game could have shown. For whole runs: `arcade-torch analyze counterfactual`.
