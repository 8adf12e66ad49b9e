"""Models whose gradients are known, and episodes of known length, without JAX."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models import make_memory
from arcade_torch.tools import Policy
from arcade_torch.tools.measures.windows import Window

SIZE, FEATURES, ACTIONS = 4, 6, 3
F64 = torch.float64


def linear_policy(
    rho: float, *, dtype: torch.dtype = F64, pixel_scale: float = 1.0, gain: float = 1.0
) -> Policy:
    """e_t = C o_t / pixel_scale, h_t = rho h_{t-1} + e_t, q_a = gain w_a . h_t; C and w as
    `matrices` gives them.
    """
    encoder, head = (matrix.to(dtype) for matrix in matrices())

    def encode(frames: Tensor) -> Tensor:
        return (frames.to(dtype) / pixel_scale).flatten(-3) @ encoder.T

    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Any
    ) -> tuple[Tensor, Any]:
        hidden = torch.zeros_like(features[:, 0]) if state is None else state
        outputs = []
        for t in range(features.shape[1]):
            hidden = rho * torch.where(is_init[:, t, None], 0.0, hidden) + features[:, t]
            outputs.append(gain * hidden @ head.T)
        return torch.stack(outputs, 1), hidden

    return Policy(
        encode, remember, lambda batch_size: torch.zeros(batch_size, FEATURES, dtype=dtype)
    )


def in_place(rho: float, head: Tensor, gain: float = 1.0) -> Any:
    """A ``remember`` like that of `linear_policy`, whose state is 1 where an episode starts and is
    changed in place.
    """

    def remember(
        features: Tensor, last_action: Tensor, is_init: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        outputs = []
        for t in range(features.shape[1]):
            state.masked_fill_(is_init[:, t, None], 1.0)
            state.mul_(rho).add_(features[:, t])
            outputs.append(gain * state @ head.T)
        return torch.stack(outputs, 1), state

    return remember


def matrices() -> tuple[Tensor, Tensor]:
    """The encoder [FEATURES, pixels] and the head [ACTIONS, FEATURES] of `linear_policy`."""
    generator = torch.Generator().manual_seed(0)
    encoder = torch.randn(FEATURES, SIZE * SIZE * 3, generator=generator, dtype=F64)
    return encoder, torch.randn(ACTIONS, FEATURES, generator=generator, dtype=F64)


class Net(nn.Module):
    """A small real network: convolution, one of our memory models in some layers, a linear head."""

    def __init__(
        self, name: str, dtype: torch.dtype = F64, layers: int = 1, **options: Any
    ) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.convolution = nn.Conv2d(3, 2, 2, 2)
        inputs = 2 * (SIZE // 2) ** 2
        self.memories = nn.ModuleList(
            make_memory(name, inputs if i == 0 else 6, 6, **options) for i in range(layers)
        )
        self.head = nn.Linear(6, ACTIONS)
        self.to(dtype)

    def encode(self, o: Tensor) -> Tensor:
        x = (o.to(self.head.weight.dtype) / 255).movedim(-1, -3).reshape(-1, 3, SIZE, SIZE)
        return torch.tanh(self.convolution(x)).flatten(1).reshape(*o.shape[:-3], -1)

    def remember(
        self, e: Tensor, last_action: Tensor, is_init: Tensor, state: Any
    ) -> tuple[Tensor, Any]:
        after = {}
        for i, memory in enumerate(self.memories):
            e, after[str(i)] = memory(e, state[str(i)], is_init)
        return self.head(e), TensorDict(after, batch_size=state.batch_size)

    def initial_state(self, batch_size: int) -> TensorDict:
        states = {
            str(i): memory.initial_state(batch_size) for i, memory in enumerate(self.memories)
        }
        return TensorDict(states, batch_size=[batch_size])


def frames(steps: int, seed: int = 0) -> Tensor:
    """uint8 [steps, SIZE, SIZE, 3]."""
    return torch.randint(
        256,
        (steps, SIZE, SIZE, 3),
        generator=torch.Generator().manual_seed(seed),
        dtype=torch.uint8,
    )


def window(steps: int, starts: Sequence[int] = (0,), seed: int = 0) -> Window:
    """A window of random frames."""
    is_init = torch.zeros(steps, dtype=torch.bool)
    is_init[list(starts)] = True
    action = torch.arange(steps) % ACTIONS
    return Window(
        frames(steps, seed), action.roll(1), is_init, action, torch.zeros(steps), None, True, seed
    )


class ToyEnv:
    """N episodes of random frames, each of a given length, begun anew when they end.

    Frames depend on the seed, the row, the episode and the step; the first pixel counts steps.
    """

    def __init__(self, lengths: Sequence[int]) -> None:
        self.lengths, self.batch_size = torch.tensor(lengths), (len(lengths),)
        self.seed, self.steps = 0, torch.zeros(len(lengths), dtype=torch.int64)
        self.last = torch.zeros(len(lengths), dtype=torch.int64)

    def set_seed(self, seed: int) -> None:
        self.seed = seed
        self.last = torch.zeros_like(self.last)

    def frame(self, row: int, step: int) -> Tensor:
        picture = frames(1, seed=(self.seed * 7919 + row * 104729 + step * 1299709) % 2**31)[0]
        picture[0, 0, 0] = step
        return picture

    def reset(self) -> TensorDict:
        self.steps = torch.zeros_like(self.steps)
        return self._root()

    def _root(self) -> TensorDict:
        pixels = torch.stack([self.frame(row, int(step)) for row, step in enumerate(self.steps)])
        values = {
            "pixels": pixels,
            "last_action": self.last.clone(),
            "is_init": (self.steps == 0).unsqueeze(-1),
        }
        return TensorDict(values, batch_size=self.batch_size)

    def step_and_maybe_reset(self, td: TensorDict) -> tuple[TensorDict, TensorDict]:
        self.last = td["action"]
        self.steps = self.steps + 1
        done = self.steps >= self.lengths
        after = {"reward": self.steps.float().unsqueeze(-1), "done": done.unsqueeze(-1)}
        self.steps = torch.where(done, 0, self.steps)
        return td.set("next", TensorDict(after, batch_size=self.batch_size)), self._root()
