"""Delta product: the gated delta net with several writes a step."""

from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes
from arcade_torch.models.fast_weights import unit_length
from arcade_torch.models.gdn import SLOW_FORGETTING, GatedDeltaNet
from arcade_torch.models.scan_matrix import (
    MatrixSteps,
    matrix_scan,
    matrix_scan_loop,
    matrix_scan_stored,
)

__all__ = ["DeltaProduct"]


class DeltaProduct(GatedDeltaNet):
    """S_t = alpha (prod_j (I - beta_j k_j k_j^T)) S_{t-1} + what the writes beta_j k_j v_j^T leave,
    for j = 1 to n in this order; y = W S_t^T q.

    n generalised Householder steps a token, each with a key, a value and a beta of its own; the
    decay alpha comes before the first. A product of n of them is any rotation in n dimensions, one
    is a reflection at most. Keys, queries, beta and alpha as in :class:`GatedDeltaNet`, which this
    is for n = 1. A token is n steps of its scan. The state ``"h"`` is [K, K].

    Args:
        input_size: D.
        hidden_size: H.
        householders: n, writes a step.
        key_size: K; None is the integer nearest to sqrt(H).
        gate_alpha: have the decay gate; False keeps alpha at 1.
        beta_range: largest beta, in (0, 2].

    Raises:
        ValueError: a size is not positive, or ``beta_range`` lies outside (0, 2].

    Source: Siems et al. (2025), arXiv 2502.10297, section 3; with the decay: gated DeltaProduct,
        there too.
    """

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        householders: int = 2,
        key_size: int | None = None,
        gate_alpha: bool = True,
        beta_range: float = 2.0,
    ) -> None:
        super().__init__(
            input_size, hidden_size, key_size=key_size, gate_alpha=gate_alpha, beta_range=beta_range
        )
        check_sizes(householders=householders)
        if householders < 1:
            raise ValueError(f"householders must be positive, got {householders}")
        self.householders = householders
        width = (1 + 2 * householders) * self.key_size
        self.query_key_value = nn.Linear(input_size, width, bias=False)
        self.gates = nn.Linear(input_size, householders + (1 if gate_alpha else 0))
        if gate_alpha:
            nn.init.constant_(self.gates.bias[householders:], SLOW_FORGETTING)

    def steps(self, x: Tensor, counters: dict[str, Tensor]) -> MatrixSteps:
        """See :meth:`FastWeights.steps`; n of them a token [B, T n, ...]."""
        n = self.householders
        size = self.key_size
        query, key, value = self.query_key_value(x).split([size, n * size, n * size], dim=-1)
        gates = self.gates(x)
        beta = self.beta_range * gates[..., :n].sigmoid().reshape(x.shape[0], -1, 1)
        key = key.reshape(x.shape[0], -1, size)
        value = value.reshape(x.shape[0], -1, size)
        log_alpha = None
        if self.gate_alpha:  # before the first write of a token
            log_alpha = F.pad(F.logsigmoid(gates[..., n:]), (0, n - 1)).reshape(beta.shape)
        query = unit_length(F.silu(query)).repeat_interleave(n, dim=1)
        return MatrixSteps(query, unit_length(F.silu(key)), beta * value, beta, log_alpha)

    def scan(self, steps: MatrixSteps, is_init: Tensor, h0: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`FastWeights.scan`."""
        start = self._at_first_writes(is_init)
        if is_init.shape[1] > 1:
            o, last = matrix_scan(steps, start, h0)
        else:  # acting
            o, states = matrix_scan_loop(steps, start, h0)
            last = states[:, -1]
        return self._after_last_writes(o), last

    def scan_stored(
        self, steps: MatrixSteps, is_init: Tensor, stored: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See :meth:`FastWeights.scan_stored`."""
        at_writes = stored.repeat_interleave(self.householders, dim=1)
        o, states = matrix_scan_stored(steps, self._at_first_writes(is_init), at_writes)
        return self._after_last_writes(o), self._after_last_writes(states)

    def _at_first_writes(self, is_init: Tensor) -> Tensor:
        """Start flags of tokens [B, T] as those of writes [B, T n]."""
        return F.pad(is_init.unsqueeze(-1), (0, self.householders - 1)).flatten(1)

    def _after_last_writes(self, x: Tensor) -> Tensor:
        """What stands after the last write of every token, [B, T, ...] of [B, T n, ...]."""
        last: Tensor = x[:, self.householders - 1 :: self.householders]
        return last

    def extra_repr(self) -> str:
        """Sizes and options, for printing."""
        return f"{super().extra_repr()}, householders={self.householders}"
