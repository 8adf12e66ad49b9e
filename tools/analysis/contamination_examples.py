"""Single examples of contamination, as in the paper's figures: pictures, and what the agent then thought."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools.analysis.gradients import encode_frames
from arcade_torch.tools.analysis.perturbation import WHITE, disturbed_frames, replayed, shuffle_order
from arcade_torch.tools.analysis.policy import Target, evaluation, outputs, policy_of, resolve
from arcade_torch.tools.analysis.windows import Window

ACTIONS = ("up", "down", "left", "right", "fire")
"""Names of the five actions, for axes."""


@dataclass(frozen=True)
class Examples:
    """One trajectory, undisturbed and disturbed in several ways.

    Attributes:
        frames: uint8 [R, F, S, S, 3], some frames of each version; row 0 is undisturbed.
        names: R rows of F, what each frame is.
        values: float64 [R, A] at the last step: relative Q-values (minus their mean), or probabilities.
        labels: [R], what was done.
        target: which outputs.
        n: index of the last step.
    """

    frames: NDArray[np.uint8]
    names: tuple[tuple[str, ...], ...]
    values: NDArray[np.float64]
    labels: tuple[str, ...]
    target: str
    n: int


@torch.no_grad()
def noise_examples(
    model: Any,
    window: Window,
    hits: Sequence[int],
    *,
    sigma: float = 1.0,
    clip: bool = False,
    feedback: bool = False,
    target: Target = "auto",
    seed: int = 0,
) -> Examples:
    """Noise on one frame each.

    Args:
        model: an agent, or anything `policy_of` takes.
        window: the trajectory; its last frame is the decision.
        hits: index of the noisy frame of each row.
        sigma: of the noise, on the [0, 1] scale.
        clip: as for `contamination`.
        feedback: as for `contamination`.
        target: as for `contamination`.
        seed: of the noise.

    Raises:
        ValueError: a hit lies outside the window.
    """
    if not hits or min(hits) < 0 or max(hits) > window.n:
        raise ValueError(f"hits must be indices from 0 to {window.n}, got {list(hits)}")
    places = np.array(hits)
    noisy = disturbed_frames(window.frames, places, np.array([sigma]), clip, seed)
    policy = policy_of(model)
    with evaluation(policy):
        clean = encode_frames(policy.encode, window.frames)
        rows = clean.repeat(1 + len(hits), 1, 1)
        rows[torch.arange(1, 1 + len(hits)), torch.as_tensor(places)] = encode_frames(policy.encode, noisy)
        values = _values(model, replayed(policy, window, rows, places, feedback), target)
    shown = noisy.clamp(0, WHITE).round().to(torch.uint8)
    pictures = [_pick(window.frames, [0, hits[0], window.n])]
    pictures += [
        torch.stack([shown[i] if t == hit else window.frames[t] for t in (0, hit, window.n)])
        for i, hit in enumerate(hits)
    ]
    names = tuple(("o_0", f"o_{{{hit}}}", f"o_{{{window.n}}}") for hit in (hits[0], *hits))
    labels = ("clean", *(f"noise on frame {hit}" for hit in hits))
    return Examples(_images(pictures), names, values, labels, resolve(model, target), window.n)


@torch.no_grad()
def shuffle_example(
    model: Any,
    window: Window,
    *,
    first: int = 1,
    last: int = 10,
    feedback: bool = False,
    target: Target = "auto",
    seed: int = 0,
) -> Examples:
    """Frames first + 1 ... last in another order; arguments as for `shuffled_beginning`.

    Raises:
        ValueError: the window is too short.
    """
    order = shuffle_order(window.n + 1, first, last, np.random.default_rng(seed))
    policy = policy_of(model)
    with evaluation(policy):
        clean = encode_frames(policy.encode, window.frames)[None]
        rows = torch.cat([clean, clean[:, torch.as_tensor(order)]])
        values = _values(model, replayed(policy, window, rows, np.array([first]), feedback), target)
    early = list(range(first + 1, min(last, first + 3) + 1))
    late = list(range(max(last + 1, window.n - 2), window.n + 1))
    pictures = [_pick(window.frames, early + late), _pick(window.frames, [int(order[t]) for t in early] + late)]
    names = tuple(tuple(f"o_{{{row[t]}}}" for t in early + late) for row in (range(window.n + 1), order.tolist()))
    return Examples(_images(pictures), names, values, ("clean", "shuffled beginning"), resolve(model, target), window.n)


def _values(model: Any, raw: Tensor, target: Target) -> NDArray[np.float64]:
    values = outputs(model, target)(raw[:, -1]).double().cpu()
    found = values if resolve(model, target) == "probs" else values - values.mean(-1, keepdim=True)
    return np.asarray(found.numpy(), dtype=np.float64)


def _pick(frames: Tensor, steps: Sequence[int]) -> Tensor:
    return frames[torch.as_tensor(steps)]


def _images(pictures: Sequence[Tensor]) -> NDArray[np.uint8]:
    return np.asarray(torch.stack(list(pictures)).cpu().numpy(), dtype=np.uint8)
