"""The memory block: layers of cell, linear, LayerNorm, LeakyReLU, with or without a skip around each."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.base import replay
from arcade_torch.models.registry import make_memory

__all__ = ["MemoryBlock"]


class MemoryBlock(nn.Module):
    """x = W u; then per layer y = cell(x), z = LeakyReLU(LayerNorm(V y)), and x + z (skip "residual") or z ("none").

    Keeps the contract of a memory model itself (``MemoryContract``), with one nested state per layer:
    ``("layer0", ...)``, ``("layer1", ...)``. LayerNorm has no parameters.

    Args:
        input_size: D.
        hidden_size: H, width of the cells and of the output.
        memory: a name (:func:`memory_names`) or a factory ``(input_size, hidden_size, **options) -> nn.Module``.
        layers: number of cells.
        skip: "residual" lets the input bypass the memory, as the paper says; "none" is what its code does.
        memory_options: passed on to the cells.

    Raises:
        ValueError: unknown memory or skip, or fewer than one layer.
    """

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        memory: str | Callable[..., nn.Module] = "lru",
        *,
        layers: int = 2,
        skip: Literal["residual", "none"] = "residual",
        memory_options: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if skip not in ("residual", "none"):
            raise ValueError(f"skip must be 'residual' or 'none', got {skip!r}")
        if layers < 1:
            raise ValueError(f"layers must be at least 1, got {layers}")
        options = memory_options or {}
        self.input_size, self.hidden_size, self.residual = input_size, hidden_size, skip == "residual"
        self.linear = nn.Linear(input_size, hidden_size)
        self.cells = nn.ModuleList(
            make_memory(memory, hidden_size, hidden_size, **options)
            if isinstance(memory, str)
            else memory(hidden_size, hidden_size, **options)
            for _ in range(layers)
        )
        self.linears = nn.ModuleList(nn.Linear(hidden_size, hidden_size) for _ in range(layers))
        self.names = [f"layer{i}" for i in range(layers)]

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Read a chunk of steps.

        Args:
            x: float [B, T, D].
            state: TensorDict [B] with one nested state per layer.
            is_init: bool [B, T].

        Returns:
            (float [B, T, H], state TensorDict [B]).
        """
        return self._run(x, state, is_init, list(self.cells), [x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """Read stored sequences, one stored state per step (see ``ReplayableMemory``); all [B, T]."""
        return self._run(x, stored, is_init, [partial(replay, cell) for cell in self.cells], x.shape[:2])

    def _run(
        self,
        x: Tensor,
        state: TensorDict,
        is_init: Tensor,
        readers: Sequence[Callable[[Tensor, TensorDict, Tensor], tuple[Tensor, TensorDict]]],
        batch_size: Sequence[int],
    ) -> tuple[Tensor, TensorDict]:
        x = self.linear(x)
        states = {}
        for name, read, linear in zip(self.names, readers, self.linears, strict=True):
            y, states[name] = read(x, state[name], is_init)
            y = F.leaky_relu_(F.layer_norm(linear(y), (self.hidden_size,)))
            x = x + y if self.residual else y
        return x, TensorDict(states, batch_size=batch_size)

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """The cells' initial states, TensorDict [batch_size] with one entry per layer."""
        cells = zip(self.names, self.cells, strict=True)
        states = {name: cell.initial_state(batch_size) for name, cell in cells}  # type: ignore[operator]
        return TensorDict(states, batch_size=[batch_size] if isinstance(batch_size, int) else list(batch_size))
