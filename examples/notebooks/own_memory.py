"""# A memory of your own, under the lens

Any `torch.nn.Module` with `forward` and `initial_state` can be the memory of an agent. We write one
whose behaviour is known, train an agent with it, and see whether the lens shows what we built.

Ours remembers exactly two things: the first frame of the episode, and the present one. That is all
that Signpost asks for: its sign is shown in the first frame alone.

This takes about half a minute on one core.
"""

# %%
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.agents import load, preset, train
from arcade_torch.models import check_memory, register_memory
from arcade_torch.tools import recall_density

FRAMES = 60_000  # of training
scratch = TemporaryDirectory()  # the run goes here; name a folder to keep it


# %%
class FirstAndNow(nn.Module):
    """Remembers the first step of an episode."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        self.input_size, self.hidden_size = input_size, hidden_size
        self.mix = nn.Linear(2 * input_size, hidden_size)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """x [B, T, D], state [B], is_init bool [B, T] to (y [B, T, H], state [B])."""
        first = state["first"]
        empty = state["empty"]
        seen = []
        for t in range(x.shape[1]):
            begins = is_init[:, t, None] | empty
            first = torch.where(begins, x[:, t], first)
            empty = torch.zeros_like(empty)
            seen.append(first)
        y = self.mix(torch.cat([torch.stack(seen, dim=1), x], dim=-1))
        return torch.relu(y), TensorDict({"first": first, "empty": empty}, batch_size=[len(x)])

    def initial_state(self, batch_size: int | list[int]) -> TensorDict:
        """Nothing remembered, TensorDict [batch_size]."""
        batch = [batch_size] if isinstance(batch_size, int) else list(batch_size)
        nothing = self.mix.weight.new_zeros(*batch, self.input_size)
        empty = torch.ones(*batch, 1, dtype=torch.bool, device=nothing.device)
        return TensorDict({"first": nothing, "empty": empty}, batch_size=batch)


# %% [markdown]
# `check_memory` holds it against the laws of a memory: chunks equal single steps, nothing crosses a
# start, neither values nor gradients, and so on. It raises if one is broken, and returns the
# largest discrepancy of each. (Leave out `empty` above and see: a first step must be the same with
# its flag and without.)

# %%
for law, discrepancy in check_memory(FirstAndNow(4, 8)).items():
    print(f"{law:40} {discrepancy:.1e}")
register_memory("first_and_now", FirstAndNow)

# %% [markdown]
# From here on the name is known everywhere, in training too.

# %%
config = preset(
    "small",
    env="SignpostEasy",
    observability="partial",
    memory="first_and_now",
    total_frames=FRAMES,
    eval_every=0,
)
result = train(config, Path(scratch.name) / "run")
agent = load(result.run_dir)
print(
    f"return {result.evaluation.mean:.2f} in greedy episodes; without memory 0.25 is the most one "
    "can expect"
)

# %%
density = recall_density(agent, episodes=64)
shares = density.mass(5)
figure, axis = plt.subplots(figsize=(5, 2.8), layout="constrained")
axis.bar(range(5), shares, color="#2171b5")
axis.set_xticks(range(5), ["first", "·", "·", "·", "last"])
axis.set_ylabel("share of the gradient")
print(" ".join(f"{share:.1%}" for share in shares))

# %% [markdown]
# Mass on the first and on the last frame, and nothing in between: not little, but zero, because no
# gradient can get there. This is a good first check of a memory of your own: does it look back as
# you meant it to?
#
# `examples/own_memory.py` brings in `torch.nn.LSTM` the same way, with `arcade-torch train --import
# FILE`.
