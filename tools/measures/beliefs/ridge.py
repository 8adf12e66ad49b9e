"""Ridge regression in closed form for many penalties at once, in its primal or its dual form."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arcade_torch.tools.measures.bootstrap import Array


@dataclass(frozen=True)
class Ridge:
    """The decomposition of a regression, from which the solution of every penalty follows.

    Inputs are centred and scaled to unit variance, targets are centred: the mean is not penalised.
    """

    inputs: Array  # [n, D], centred and scaled
    mean: Array  # [D], of the inputs
    scale: Array  # [D]; 1 where an input is constant
    targets: Array  # [n, M], centred
    offset: Array  # [M], mean of the targets
    values: Array  # eigenvalues of X'X (primal) or of XX' (dual), where X are the inputs
    vectors: Array  # their eigenvectors, in columns
    is_dual: bool

    @classmethod
    def of(cls, inputs: Any, targets: Array, is_dual: bool | None = None) -> "Ridge":
        """Decompose a regression.

        Args:
            inputs: floats [n, D].
            targets: float64 [n, M].
            is_dual: whether the matrix of samples [n, n] is decomposed in place of that of inputs
                [D, D]; by default the smaller of the two. The solutions are the same.
        """
        inputs = np.asarray(inputs, np.float64)
        count, width = inputs.shape
        mean = inputs.mean(axis=0)
        # not by the deviation: the mean of equal numbers is rounded, and may be another number
        varies = inputs.min(axis=0) < inputs.max(axis=0)
        scale = np.where(varies, inputs.std(axis=0), 1.0)
        scaled = (inputs - mean) / scale
        offset = targets.mean(axis=0)
        if is_dual is None:
            is_dual = width > count
        gram = scaled @ scaled.T if is_dual else scaled.T @ scaled
        values, vectors = np.linalg.eigh(gram)
        return cls(scaled, mean, scale, targets - offset, offset, values, vectors, is_dual)

    def weights(self, penalty: float) -> Array:
        """The weights [D, M] that minimise squared error + ``penalty * n`` * squared weights."""
        damped = np.maximum(self.values, 0.0) + penalty * len(self.inputs)
        if self.is_dual:
            projected = self.vectors.T @ self.targets
            return np.asarray(self.inputs.T @ (self.vectors @ (projected / damped[:, None])))
        projected = self.vectors.T @ (self.inputs.T @ self.targets)
        return np.asarray(self.vectors @ (projected / damped[:, None]))

    def predict(self, inputs: Any, penalties: Sequence[float]) -> list[Array]:
        """Targets [k, M] of inputs [k, D], for each penalty."""
        scaled = (inputs - self.mean) / self.scale
        return [self.offset + scaled @ self.weights(penalty) for penalty in penalties]
