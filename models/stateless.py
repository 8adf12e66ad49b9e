"""Models without memory: the stateless cell, and the paper's feed-forward layers."""

from collections.abc import Sequence

from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models.memory import Memory, batch_shape

__all__ = ["FeedForward", "Stateless"]


class Stateless(Memory):
    """y = LeakyReLU(W x + b); the state is an empty TensorDict.

    A control: a network with this cell has every part of a memory network except the memory.

    Args:
        input_size: D.
        hidden_size: H.

    Raises:
        ValueError: sizes not positive.

    Source: POPGym Arcade's "MLP" cell.
    """

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size)
        self.linear = nn.Linear(input_size, hidden_size)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Apply the layer to each step; returns ([B, T, H], the given state)."""
        self._check(x, state, is_init)
        return nn.functional.leaky_relu(self.linear(x)), state

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Apply the layer to each step; returns ([B, T, H], the given states)."""
        self._check(x, stored, is_init, batch_ndim=2)
        return nn.functional.leaky_relu(self.linear(x)), stored


class FeedForward(nn.Module):
    """Linear, LayerNorm with parameters, LeakyReLU, twice. Keeps the contract of a memory model,
    with an empty state.

    The stateless cell ``"mlp"`` stands in the memory block; this takes the place of the whole
    block, as in the published "MLP" agents.

    Args:
        input_size: D.
        hidden_size: H, width of both layers.

    Source: POPGym Arcade (ICML 2026), feed-forward learner of the reference implementation.
    """

    def __init__(self, input_size: int, hidden_size: int = 256) -> None:
        super().__init__()
        self.input_size = input_size
        self.hidden_size = hidden_size
        layers: list[nn.Module] = []
        for size in (input_size, hidden_size):
            layers += [
                nn.Linear(size, hidden_size),
                nn.LayerNorm(hidden_size),
                nn.LeakyReLU(inplace=True),
            ]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Each step on its own: float [B, T, D] to [B, T, H]; the state stays empty."""
        return self.layers(x), state

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """An empty TensorDict [batch_size]."""
        return TensorDict({}, batch_size=batch_shape(batch_size))
