"""TTT-linear: the state is a linear model that learns, by one gradient step a time step, to recall
values by keys.
"""

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models.fast_weights import FastWeights, unit_length
from arcade_torch.models.rotary import angles, rotate
from arcade_torch.models.scan import linear_scan
from arcade_torch.models.scan_matrix import MatrixSteps

__all__ = ["TTTLinear"]

INITIAL_DEVIATION = 0.02


class TTTLinear(FastWeights):
    """W_t = W_{t-1} - eta grad 1/2 \\|W k - v\\|^2 = W_{t-1} (I - eta k k^T) + eta v k^T, y = U W_t
    q + c.

    k and q have length one and are rotated by the number of steps since the episode began (RoPE);
    eta = sigmoid(w . x + b), so no step overshoots; every episode begins with a learned W_0.

    The state ``"h"`` [K, K] is (W_t - W_0)^T: zeros at the start of an episode, so that an env's
    reset, a primer and a stale buffer need not know W_0, and its gradient does not end where a
    state was stored. ``start`` is W_0^T. The key axis of both is in the order of
    :func:`~arcade_torch.models.rotary.rotate`: first the first channels of all pairs that turn,
    then the second ones. ``"step"`` int64 [] counts the steps of the episode.

    The paper names neither eta nor W_0, the width or a normalisation, and its code has no such
    model: this is our own variant.

    Args:
        input_size: D.
        hidden_size: H.
        key_size: K; None is the integer nearest to sqrt(H). The last channel of an odd number is
            not rotated.

    Raises:
        ValueError: a size is not positive.

    Source: Sun et al. (2025), arXiv 2407.04620, section 2 (TTT-Linear, one token a step); POPGym
        Arcade, appendix on memory models.
    """

    def __init__(self, input_size: int, hidden_size: int, *, key_size: int | None = None) -> None:
        super().__init__(input_size, hidden_size, key_size)
        self.rate = nn.Linear(input_size, 1)
        self.start = nn.Parameter(INITIAL_DEVIATION * torch.randn(self.key_size, self.key_size))
        self.output = nn.Linear(self.key_size, hidden_size)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        return super().state_leaves() | {"step": ((), torch.int64)}

    def count(self, state: TensorDict, is_init: Tensor) -> dict[str, Tensor]:
        """Steps of the episode up to and with each step: a sum with resets, hence a scan."""
        one = torch.ones_like(is_init, dtype=torch.int64)
        return {"step": linear_scan(one, one, is_init, state["step"])}

    def steps(self, x: Tensor, counters: dict[str, Tensor]) -> MatrixSteps:
        """See :meth:`FastWeights.steps`; values are what W_0 does not already say."""
        query, key, value = self.query_key_value(x).chunk(3, dim=-1)
        cosine, sine = angles(counters["step"] - 1, self.key_size, x.dtype)
        query = rotate(unit_length(query), cosine, sine)
        key = rotate(unit_length(key), cosine, sine)
        eta = self.rate(x).sigmoid()
        return MatrixSteps(query, key, eta * (value - key @ self.start), eta)

    def read_out(self, x: Tensor, steps: MatrixSteps, o: Tensor) -> Tensor:
        """See :meth:`FastWeights.read_out`."""
        y: Tensor = self.output(o + steps.query @ self.start)
        return y
