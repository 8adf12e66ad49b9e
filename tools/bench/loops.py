"""Memory models with a plain loop over time in the place of their scan: what a scan is worth.

Parameters and results are those of the model itself, so a model's weights can be loaded.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from arcade_torch.models import matrix_scan_loop
from arcade_torch.models.gdn import GatedDeltaNet
from arcade_torch.models.linear_transformer import LinearTransformer
from arcade_torch.models.lru import LRU
from arcade_torch.models.memory import Memory
from arcade_torch.models.mingru import MinGRU
from arcade_torch.models.scan_matrix import MatrixSteps
from arcade_torch.models.ttt import TTTLinear


def unbind_loop(
    a: Tensor, b: Tensor, start: Tensor | None = None, h0: Tensor | None = None
) -> Tensor:
    """The loop that is fastest under autograd; the function of ``linear_scan`` for one state ``h0``
    or none.

    Indexing ``b[:, t]`` instead makes the backward pass quadratic in T.
    """
    h = b.new_zeros(b[:, 0].shape) if h0 is None else h0
    begins: Sequence[Tensor | None] = [None] * b.shape[1]
    if start is not None:
        features = [1] * (b.ndim - 2)
        begins = start.reshape(*start.shape, *features).unbind(1)
    states = []
    for a_t, b_t, begins_t in zip(a.expand(b.shape).unbind(1), b.unbind(1), begins, strict=True):
        before = h if begins_t is None else h.masked_fill(begins_t, 0)
        h = torch.addcmul(b_t, a_t, before)
        states.append(h)
    return torch.stack(states, dim=1)


class LoopLRU(LRU):
    """The LRU, solved by `unbind_loop`."""

    scan = staticmethod(unbind_loop)


class LoopMinGRU(MinGRU):
    """MinGRU, solved by `unbind_loop`."""

    scan = staticmethod(unbind_loop)


class MatrixLoop:
    """Fast weights that are solved by ``matrix_scan_loop``."""

    def scan(self, steps: MatrixSteps, is_init: Tensor, h0: Tensor) -> tuple[Tensor, Tensor]:
        """The answers [B, T, V], and the last state [B, K, V]."""
        o, states = matrix_scan_loop(steps, is_init, h0)
        return o, states[:, -1]


class LoopLinearTransformer(MatrixLoop, LinearTransformer):
    """The linear transformer, solved by a loop."""


class LoopGatedDeltaNet(MatrixLoop, GatedDeltaNet):
    """The gated delta net with its default options, solved by a loop."""


class LoopTTT(MatrixLoop, TTTLinear):
    """TTT-linear, solved by a loop."""


LOOPS: dict[str, type[Memory]] = {
    "lru": LoopLRU,
    "mingru": LoopMinGRU,
    "linear_transformer": LoopLinearTransformer,
    "gdn": LoopGatedDeltaNet,
    "ttt": LoopTTT,
}
"""Name of a memory model that scans -> the same model with a loop."""
