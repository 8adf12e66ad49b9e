"""What the models with a matrix as state share: everything but what a step writes and how the
read-out is used.
"""

import math
from abc import abstractmethod

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.memory import Memory
from arcade_torch.models.scan_matrix import MatrixSteps, matrix_scan, matrix_scan_stored

__all__ = ["FastWeights", "unit_length"]


class FastWeights(Memory):
    """Base of the models whose state ``"h"`` is a matrix [K, V] that every step writes to and reads
    from.

    Args:
        input_size: D.
        hidden_size: H, features of the output.
        key_size: K, side of the matrix; None takes the integer nearest to sqrt(H), so that the
            state has about as many numbers as that of a vector model of the same H.

    Raises:
        ValueError: a size is not positive.
    """

    def __init__(self, input_size: int, hidden_size: int, key_size: int | None) -> None:
        super().__init__(input_size, hidden_size)
        self.key_size = max(1, round(math.sqrt(hidden_size))) if key_size is None else key_size
        check_sizes(key_size=self.key_size)
        if self.key_size < 1:
            raise ValueError(f"key_size must be positive, got {key_size}")
        self.state_shape = (self.key_size, self.key_size)
        self.query_key_value = nn.Linear(input_size, 3 * self.key_size, bias=False)

    @abstractmethod
    def steps(self, x: Tensor, counters: dict[str, Tensor]) -> MatrixSteps:
        """What every step does to the matrix, for inputs [B, T, D] and :meth:`count`'s counters [B,
        T].
        """

    @abstractmethod
    def read_out(self, x: Tensor, steps: MatrixSteps, o: Tensor) -> Tensor:
        """The output [B, T, H] from what the matrix answered, o = S^T q [B, T, V]."""

    def count(self, state: TensorDict, is_init: Tensor) -> dict[str, Tensor]:
        """What else the state holds, after each step [B, T]; nothing."""
        return {}

    def scan(self, steps: MatrixSteps, is_init: Tensor, h0: Tensor) -> tuple[Tensor, Tensor]:
        """:func:`matrix_scan`: (o [B, T, V], last state [B, K, V])."""
        return matrix_scan(steps, is_init, h0)

    def scan_stored(
        self, steps: MatrixSteps, is_init: Tensor, stored: Tensor
    ) -> tuple[Tensor, Tensor]:
        """:func:`matrix_scan_stored`: (o [B, T, V], all states [B, T, K, V])."""
        return matrix_scan_stored(steps, is_init, stored)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``; the memory it needs does not grow with T K V."""
        self._check(x, state, is_init)
        counters = self.count(state, is_init)
        steps = self.steps(x, counters)
        o, h = self.scan(steps, is_init, state["h"])
        last = {name: counter[:, -1] for name, counter in counters.items()}
        return self.read_out(x, steps, o), TensorDict({"h": h, **last}, batch_size=[x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``."""
        self._check(x, stored, is_init, batch_ndim=2)
        counters = self.count(stored, is_init)
        steps = self.steps(x, counters)
        o, h = self.scan_stored(steps, is_init, stored["h"])
        return self.read_out(x, steps, o), TensorDict({"h": h, **counters}, batch_size=x.shape[:2])


def unit_length(x: Tensor) -> Tensor:
    """x / (\\|x\\| + 1e-6) over the last dimension."""
    length: Tensor = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return x / (length + 1e-6)
