"""The stateless cell: the control that has every part of a memory network except the memory."""

from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models.base import Memory

__all__ = ["Stateless"]


class Stateless(Memory):
    """y = LeakyReLU(W x + b); the state is an empty TensorDict.

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
