"""Frame stacking: the last few inputs side by side, the memory that people ask for first."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.memory import Memory

__all__ = ["FrameStack", "last_inputs"]


class FrameStack(Memory):
    """y_t = LeakyReLU(W [x_t, x_{t-1}, ..., x_{t-k+1}] + b), with zeros before the episode's first
    step.

    A baseline: nothing is learned about what to keep, and what is k steps old is gone. In a
    network it stacks the features of the frames, not their pixels; each frame is encoded once.

    The state ``"h"`` is the last k - 1 inputs [k - 1, D], the newest first.

    Args:
        input_size: D.
        hidden_size: H.
        frames: k, number of inputs that are seen, the current one included.

    Raises:
        ValueError: sizes not positive, or ``frames`` below 2.

    Source: Mnih et al. (2015), Nature 518, where the last four frames are one observation.
    """

    def __init__(self, input_size: int, hidden_size: int, *, frames: int = 4) -> None:
        super().__init__(input_size, hidden_size)
        check_sizes(frames=frames)
        if frames < 2:
            raise ValueError(
                f"frames must be at least 2 (the current one and the one before), got {frames}; "
                "'mlp' sees one"
            )
        self.frames = frames
        self.state_shape = (frames - 1, input_size)
        self.linear = nn.Linear(frames * input_size, hidden_size)

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`; the state is [..., k - 1, D]."""
        window = last_inputs(x, h0, is_init)
        return F.leaky_relu(self.linear(window.flatten(2))), window[:, :, :-1]

    def extra_repr(self) -> str:
        """Sizes and options, for printing."""
        return f"{super().extra_repr()}, frames={self.frames}"


def last_inputs(x: Tensor, before: Tensor, is_init: Tensor) -> Tensor:
    """At every step the input and the k - 1 before it in the episode, zeros where there are none.

    Args:
        x: float [B, T, D].
        before: the inputs before index 0, the newest first, [B, k - 1, D]; or [B, T, k - 1, D],
            those before each step, loaded at index 0 and wherever ``is_init`` is set.
        is_init: bool [B, T].

    Returns:
        [B, T, k, D], the newest first.
    """
    stored = before.to(x.dtype)
    if before.ndim == x.ndim:  # every start but index 0 loads zeros
        first = torch.where(is_init[:, :1, None], 0, stored)
        stored = F.pad(first.unsqueeze(1), (0, 0, 0, 0, 0, x.shape[1] - 1))
    load = (is_init | (torch.arange(x.shape[1], device=x.device) == 0)).unsqueeze(-1)
    inputs = [x]
    for age in range(stored.shape[2]):
        # what was one step younger one step ago, or what was stored
        one_step_ago = F.pad(inputs[-1], (0, 0, 1, 0))[:, :-1]
        inputs.append(torch.where(load, stored[:, :, age], one_step_ago))
    return torch.stack(inputs, dim=2)
