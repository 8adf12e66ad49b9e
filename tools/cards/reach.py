"""How far back the inputs of a memory matter: gradient reach and context length.

*Gradient reach*: the size of the Jacobian of the output at step T by the input k steps before,
``|d y_T / d x_{T-k}|`` in the Frobenius norm, over k, divided by its largest value. It is what
learning has to work with: where it vanishes, no gradient tells a memory what to keep. Measured with
the weights that the memory begins with.

*Context length*: the largest k at which another input ``x_{T-k}`` changes ``y_T`` at all. Beyond a
window nothing changes, not by one bit: there the length is exact. A memory that fades changes by
ever less, and its length depends on what counts: here more than a millionth of the largest change
that any step makes. Both in float64, on one episode that begins at index 0.

Source: context length as in "Unraveling the Complexity of Memory in RL Agents", arXiv 2412.06531:
a task shows long-term memory only where it asks for something from further back than the agent's
context.
"""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from arcade_torch.agents.checked import require

Array = NDArray[np.float64]

MOST_LAGS = 128
"""Gradient reach is measured so many steps back."""
LONGEST = 512
"""Context length is looked for so many steps back."""
THRESHOLD = 1e-6
"""What counts as a change, as a share of the largest."""
ROWS = 64
"""Episodes at once."""
DRAWS = 2
"""Directions of the output, a random one an episode, from which the Frobenius norm is estimated."""


@dataclass(frozen=True)
class Reach:
    """Gradient reach."""

    norms: Array  # float64 [L], by lag from 0 up, the largest is 1; zeros without any gradient

    def horizon(self, share: float = 0.01) -> int:
        """The largest lag at which the gradient is at least this share of the largest; 0 if there
        is none.
        """
        large = np.flatnonzero(self.norms >= share)
        return int(large[-1]) if len(large) else 0


@dataclass(frozen=True)
class Context:
    """Context length."""

    steps: int  # the largest lag that counts; 0 where only the present does, or nothing
    exact: bool  # whether nothing changes beyond, not by one bit, as far as was looked
    longest: int  # the largest lag that was looked at

    @property
    def text(self) -> str:
        """The length in words."""
        if self.steps >= self.longest:
            return f"{self.longest} steps or more"
        words = "1 step" if self.steps == 1 else f"{self.steps} steps"
        return f"{words}, exactly" if self.exact else f"{words}, fading out"


def gradient_reach(memory: nn.Module, lags: int = MOST_LAGS, seed: int = 0) -> Reach:
    """Measure gradient reach.

    Args:
        memory: a memory model that names its ``input_size``; a copy of it is measured.
        lags: how many steps back, at least 0.
        seed: of the inputs, independent normal numbers.

    Returns:
        norms float64 [lags + 1].
    """
    require(lags >= 0, "lags", lags, "0 or more")
    subject, width, generator = _prepare(memory, seed)
    x = _normal(generator, ROWS, lags + 1, width).requires_grad_()
    y = _last(subject, x)
    squares = torch.zeros(lags + 1, dtype=torch.float64)
    if y.requires_grad:
        for _ in range(DRAWS):
            direction = _normal(generator, *y.shape)
            direction = direction / direction.norm(dim=1, keepdim=True)
            (gradient,) = torch.autograd.grad(
                y, x, direction, retain_graph=True, allow_unused=True, materialize_grads=True
            )
            squares += gradient.square().sum((0, 2)).flip(0)
    norms = squares.sqrt()
    largest = norms.max()
    return Reach((norms / largest if largest > 0 else norms).numpy())


@torch.no_grad()
def context_length(
    memory: nn.Module, longest: int = LONGEST, threshold: float = THRESHOLD, seed: int = 0
) -> Context:
    """Look for the furthest input that the output depends on.

    Args:
        memory: a memory model that names its ``input_size``; a copy of it is measured.
        longest: how many steps back to look, at least 1.
        threshold: share of the largest change of any step that counts as a change.
        seed: of the inputs, independent normal numbers.
    """
    require(longest >= 1, "longest", longest, "1 or more")
    require(0 <= threshold < 1, "threshold", threshold, "at least 0 and below 1")
    subject, width, generator = _prepare(memory, seed)
    changes = list[float]()
    for first in range(0, longest + 1, ROWS):
        lags = torch.arange(first, min(first + ROWS, longest + 1))
        x = _normal(generator, len(lags), longest + 1, width)
        other = x.clone()
        row = torch.arange(len(lags))
        other[row, longest - lags] = _normal(generator, len(lags), width)
        changes += (_last(subject, x) - _last(subject, other)).abs().amax(1).tolist()
    sizes = np.array(changes)
    counting = np.flatnonzero(sizes > threshold * sizes.max())
    steps = int(counting[-1]) if len(counting) else 0
    return Context(steps, bool((sizes[steps + 1 :] == 0).all()), longest)


def _prepare(memory: nn.Module, seed: int) -> tuple[Any, int, torch.Generator]:
    """A copy in float64 and evaluation mode, the width of its inputs, and what draws them."""
    width = getattr(memory, "input_size", None)
    if not isinstance(width, int):
        raise ValueError(f"input_size of {type(memory).__name__} is {width!r}: set it in __init__")
    return copy.deepcopy(memory).double().eval(), width, torch.Generator().manual_seed(seed)


def _normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _last(memory: Any, x: Tensor) -> Tensor:
    """The output at the last step of episodes that begin at the first, float64 [B, H]."""
    is_init = torch.zeros(x.shape[:2], dtype=torch.bool)
    is_init[:, 0] = True
    y: Tensor = memory(x, memory.initial_state(len(x)), is_init)[0]
    return y[:, -1]
