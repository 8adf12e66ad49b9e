"""Linear transformer: attention with a kernel instead of the softmax, hence a recurrence."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_flags
from arcade_torch.models.fast_weights import FastWeights
from arcade_torch.models.scan_matrix import MatrixSteps

__all__ = ["LinearTransformer"]

EPSILON = 1e-6  # keeps the quotient finite where a kernel underflows


class LinearTransformer(FastWeights):
    """S_t = S_{t-1} + phi(k) v^T, n_t = n_{t-1} + phi(k), y = W (S^T phi(q)) / (n . phi(q)) + x,
    phi = 1 + elu.

    k, q and v are linear in x, without bias. The state ``"h"`` is [K, K + 1]: S, and n as its last
    column. ``+ x`` becomes a linear map when the sizes differ.

    Args:
        input_size: D.
        hidden_size: H.
        key_size: K; None is the integer nearest to sqrt(H).
        legacy_normaliser: divide by phi(k_t) . phi(q_t), the last key alone, as the reference
            package does; outputs then grow with the length of the episode, and the state is S
            alone. ``check_memory`` refuses it, with the law "an average of equal values is that
            value".

    Raises:
        ValueError: a size is not positive.

    Source: Katharopoulos et al. (2020), arXiv 2006.16236, eqs. 18 to 20; POPGym Arcade, appendix on
        memory models (whose equation also puts phi around the values; neither that paper's code nor
        the original does).
    """

    averages_values = True

    def __init__(
        self,
        input_size: int,
        hidden_size: int,
        *,
        key_size: int | None = None,
        legacy_normaliser: bool = False,
    ) -> None:
        super().__init__(input_size, hidden_size, key_size)
        check_flags(legacy_normaliser=legacy_normaliser)
        self.legacy_normaliser = legacy_normaliser
        if not legacy_normaliser:
            self.state_shape = (self.key_size, self.key_size + 1)
        self.output = nn.Linear(self.key_size, hidden_size)
        self.skip: nn.Module = nn.Identity()
        if input_size != hidden_size:
            self.skip = nn.Linear(input_size, hidden_size, bias=False)

    def steps(self, x: Tensor, counters: dict[str, Tensor]) -> MatrixSteps:
        """See :meth:`FastWeights.steps`."""
        query, key, value = self.query_key_value(x).chunk(3, dim=-1)
        if not self.legacy_normaliser:
            value = F.pad(value, (0, 1), value=1.0)
        return MatrixSteps(1 + F.elu(query), 1 + F.elu(key), value)

    def read_out(self, x: Tensor, steps: MatrixSteps, o: Tensor) -> Tensor:
        """See :meth:`FastWeights.read_out`."""
        if self.legacy_normaliser:
            normaliser = torch.linalg.vecdot(steps.query, steps.key).unsqueeze(-1)
        else:
            o, normaliser = o.split([self.key_size, 1], dim=-1)
        y: Tensor = self.output(o / (normaliser + EPSILON)) + self.skip(x)
        return y
