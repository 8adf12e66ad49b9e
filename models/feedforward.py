"""The paper's memory-free network behind its encoder: two layers, nothing remembered."""

from collections.abc import Sequence

from tensordict import TensorDict
from torch import Tensor, nn

__all__ = ["FeedForward"]


class FeedForward(nn.Module):
    """Linear, LayerNorm with parameters, LeakyReLU, twice. Keeps the contract of a memory model, with an empty state.

    Not the stateless cell ``"mlp"``, which stands *in* the memory block and changes nothing around it: this takes the
    block's place, as in the published "MLP" agents.

    Args:
        input_size: D.
        hidden_size: H, width of both layers.

    Source: POPGym Arcade (ICML 2026), feed-forward learner of the reference implementation.
    """

    def __init__(self, input_size: int, hidden_size: int = 256) -> None:
        super().__init__()
        self.input_size, self.hidden_size = input_size, hidden_size
        layers: list[nn.Module] = []
        for size in (input_size, hidden_size):
            layers += [nn.Linear(size, hidden_size), nn.LayerNorm(hidden_size), nn.LeakyReLU(inplace=True)]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Each step on its own: float [B, T, D] to [B, T, H]; the state stays empty."""
        return self.layers(x), state

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """An empty TensorDict [batch_size]."""
        return TensorDict({}, batch_size=[batch_size] if isinstance(batch_size, int) else list(batch_size))
