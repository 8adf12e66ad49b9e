"""Gated delta net: a matrix memory that corrects what it has stored under a key, and forgets."""

from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_flags, is_number
from arcade_torch.models.fast_weights import FastWeights, unit_length
from arcade_torch.models.scan_matrix import MatrixSteps, matrix_scan_loop

__all__ = ["GatedDeltaNet"]

SLOW_FORGETTING = 4.0  # bias of the decay gate: sigmoid of it is 0.98


class GatedDeltaNet(FastWeights):
    """S_t = alpha (I - beta k k^T) S_{t-1} + beta k v^T, y = W S_t^T q, with keys and queries of
    length one.

    k and q are silu of linear maps, divided by their length; v is linear; beta = 2 sigmoid(w . x +
    b) and alpha = sigmoid(a . x + c) are numbers. S is the transpose of the paper's H. The state
    ``"h"`` is [K, K].

    Differs from the paper's equation by the decay alpha, silu, unit length and the factor 2, as its
    code does and as "gated" means in the literature; from that code by the side on which the
    transition acts.

    Args:
        input_size: D.
        hidden_size: H.
        key_size: K; None is the integer nearest to sqrt(H).
        gate_alpha: have the decay gate; False keeps alpha at 1.
        beta_range: largest beta, in (0, 2]; beyond 1 what was stored under the key changes sign.
        legacy_left: let the transition act on values instead of keys, as the reference package
            does: it then erases the part of *every* stored value that points along the current key.
                Runs step by step (slow).

    Raises:
        ValueError: a size is not positive, or ``beta_range`` lies outside (0, 2].

    Source: Yang et al. (2025), arXiv 2412.06464, eq. 10; POPGym Arcade, appendix on memory models.
    """

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        key_size: int | None = None,
        gate_alpha: bool = True,
        beta_range: float = 2.0,
        legacy_left: bool = False,
    ) -> None:
        super().__init__(input_size, hidden_size, key_size)
        check_flags(gate_alpha=gate_alpha, legacy_left=legacy_left)
        if not is_number(beta_range) or not 0 < beta_range <= 2:
            raise ValueError(
                f"beta_range must lie in (0, 2], beyond which the memory explodes; got {beta_range}"
            )
        self.gate_alpha = gate_alpha
        self.beta_range = beta_range
        self.legacy_left = legacy_left
        self.gates = nn.Linear(input_size, 2 if gate_alpha else 1)
        if gate_alpha:
            nn.init.constant_(self.gates.bias[1:], SLOW_FORGETTING)
        self.output = nn.Linear(self.key_size, hidden_size)

    def steps(self, x: Tensor, counters: dict[str, Tensor]) -> MatrixSteps:
        """See :meth:`FastWeights.steps`."""
        query, key, value = self.query_key_value(x).chunk(3, dim=-1)
        gates = self.gates(x)
        beta = self.beta_range * gates[..., :1].sigmoid()
        log_alpha = F.logsigmoid(gates[..., 1:]) if self.gate_alpha else None
        return MatrixSteps(
            unit_length(F.silu(query)), unit_length(F.silu(key)), beta * value, beta, log_alpha
        )

    def read_out(self, x: Tensor, steps: MatrixSteps, o: Tensor) -> Tensor:
        """See :meth:`FastWeights.read_out`."""
        y: Tensor = self.output(o)
        return y

    def scan(self, steps: MatrixSteps, is_init: Tensor, h0: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`FastWeights.scan`."""
        if not self.legacy_left:
            return super().scan(steps, is_init, h0)
        o, states = matrix_scan_loop(steps, is_init, h0, erase_values=True)
        return o, states[:, -1]

    def scan_stored(
        self, steps: MatrixSteps, is_init: Tensor, stored: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See :meth:`FastWeights.scan_stored`."""
        if not self.legacy_left:
            return super().scan_stored(steps, is_init, stored)
        return matrix_scan_loop(steps, is_init, stored, erase_values=True)
