"""Replaying a recorded trajectory with something changed in it."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools.analysis.policy import policy_of
from arcade_torch.tools.analysis.windows import Window

WHITE = 255.0
"""Pixel value that stands for 1."""


def disturbed_frames(
    frames: Tensor, places: NDArray[np.int64], sigmas: NDArray[np.float64], clip: bool, seed: int
) -> Tensor:
    """Single frames with Gaussian noise; the strengths of one frame share its draw."""
    generator = torch.Generator().manual_seed(seed)
    chosen = frames[torch.as_tensor(places)].to(torch.float32)
    noise = torch.randn(chosen.shape, generator=generator).to(chosen.device)
    scale = torch.as_tensor(WHITE * sigmas, dtype=torch.float32, device=chosen.device)
    noisy = (chosen[:, None] + scale[:, None, None, None] * noise[:, None]).flatten(0, 1)
    return noisy.clamp(0.0, WHITE) if clip else noisy


def shuffle_order(total: int, first: int, last: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of ``total`` frames with those from first + 1 to last in another order."""
    if not 0 <= first <= last - 2 or last >= total:
        raise ValueError(f"cannot permute frames {first + 1} to {last} of {total}")
    order = np.arange(total)
    part = order[first + 1 : last + 1]
    while (order == np.arange(total)).all():  # the identity is no shuffle
        order[first + 1 : last + 1] = rng.permutation(part)
    return order


@torch.no_grad()
def replayed(model: Any, window: Window, features: Tensor, touched: NDArray[np.int64], feedback: bool) -> Tensor:
    """What the memory says at every step of several versions of a trajectory."""
    policy, count = policy_of(model), features.shape[0]
    state = repeated(policy.initial_state(1) if window.state is None else window.state, count)
    actions = window.last_action.expand(count, -1)
    starts = window.is_init.bool().expand(count, -1)
    if not feedback:
        return policy.remember(features, actions, starts, state)[0]
    # Up to the first difference nothing has been chosen by the replay yet: the recorded actions lead there.
    free = int(touched.min(initial=features.shape[1] - 1))
    out, state = policy.remember(features[:, : free + 1], actions[:, : free + 1], starts[:, : free + 1], state)
    parts = [out]
    for t in range(free + 1, features.shape[1]):
        chosen = policy.greedy(out[:, -1:])
        out, state = policy.remember(features[:, t : t + 1], chosen, starts[:, t : t + 1], state)
        parts.append(out)
    return torch.cat(parts, 1)


def repeated(state: Any, count: int) -> Any:
    """A batch of equal states from a batch of one: a TensorDict, a tensor, or None."""
    if state is None:
        return None
    if hasattr(state, "batch_size"):
        return state.reshape(1).expand(count).clone()
    return state.expand(count, *state.shape[1:])
