"""Pixel saliency: how the decision at step n depends on every pixel seen at steps t <= n.

``S(o_t) = sum_a || d Q(s_n, a) / d o_t ||^2``, the norm taken over colour channels at each pixel. Computed in two
stages, see ``gradients``.

Source: POPGym Arcade (ICML 2026), pixel saliency; the reference implementation differentiates the sum over actions
instead (``reduce="sum", norm="l1"``, divided by 3).
"""

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.tools.analysis.gradients import Norm, Reduce, encode_frames, frame_norms, memory_jacobian
from arcade_torch.tools.analysis.policy import Target, evaluation, outputs, policy_of, resolve

__all__ = ["Norm", "Reduce", "Saliency", "Target", "frame_gradients", "saliency"]


@dataclass(frozen=True)
class Saliency:
    """What `saliency` found.

    Attributes:
        maps: float32 [n + 1, H, W], one map a frame; sums over pixels where the norm is additive give ``per_frame``.
        per_frame: float64 [n + 1], for each frame sum over actions of the norm over all pixels and channels.
        output: float32 [A], what was differentiated, at step n.
        n: index of the step whose decision is explained.
        reduce: how actions were put together.
        norm: which norm.
        target: which output.
    """

    maps: NDArray[np.float32]
    per_frame: NDArray[np.float64]
    output: NDArray[np.float32]
    n: int
    reduce: str
    norm: str
    target: str

    def shares(self) -> NDArray[np.float64]:
        """float64 [n + 1], `per_frame` divided by its sum (zeros where all gradients vanish)."""
        total = self.per_frame.sum()
        return self.per_frame / total if total > 0 else np.zeros_like(self.per_frame)


def saliency(
    model: Any,
    frames: Tensor,
    last_action: Tensor | None = None,
    is_init: Tensor | None = None,
    state: Any = None,
    *,
    n: int = -1,
    reduce: Reduce = "per_action",
    norm: Norm = "l2sq",
    target: Target = "auto",
    chunk: int = 8,
    dtype: torch.dtype = torch.float32,
) -> Saliency:
    """Gradient of the outputs at step n with respect to every frame up to n.

    Args:
        model: an agent, a network with ``encode``, ``remember`` and ``initial_state``, a `Policy`, or a pair
            ``(encode, remember)``; see `policy_of`.
        frames: uint8 or float [T, H, W, C], values 0 to 255: what the agent saw, oldest first.
        last_action: int64 [T], the action that led to each frame; zeros by default.
        is_init: bool [T] or [T, 1], whether a frame opens an episode; all false by default.
        state: recurrent state before the first frame, batch of one; the model's initial state by default.
        n: index of the step to explain, negative from the end.
        reduce: ``per_action`` (the paper: norms of single actions, summed) or ``sum`` (norm of the gradient of the sum
            over actions, in which opposite effects cancel).
        norm: ``l2sq``, ``l2`` or ``l1``, over the channels of a pixel for ``maps``, over the frame for ``per_frame``.
        target: what is differentiated, see `outputs`: Q-values or, for a policy, action probabilities by default.
        chunk: frames pushed through the encoder at once; bounds memory.
        dtype: of frames and gradients, float32 or float64 (the model's parameters must match).

    Returns:
        Maps and sums as numpy arrays.

    Raises:
        ValueError: a shape does not fit, n is out of range, or an option has an unknown value.
        TypeError: ``model`` has none of the forms above.
    """
    steps, last_action, is_init = _window(frames, last_action, is_init, n)
    maps, totals, output = frame_gradients(
        model, frames[:steps], last_action, is_init, state, reduce, norm, target, chunk, dtype, maps=True
    )
    assert maps is not None
    return Saliency(
        maps.to(torch.float32).cpu().numpy(),
        totals.double().cpu().numpy(),
        output.float().cpu().numpy(),
        steps - 1,
        reduce,
        norm,
        resolve(model, target),
    )


def frame_gradients(
    model: Any,
    frames: Tensor,
    last_action: Tensor,
    is_init: Tensor,
    state: Any,
    reduce: Reduce,
    norm: Norm,
    target: Target,
    chunk: int,
    dtype: torch.dtype = torch.float32,
    maps: bool = False,
) -> tuple[Tensor | None, Tensor, Tensor]:
    """Both stages for the last of some frames; arguments as in `saliency`."""
    for name, value, kind in (("reduce", reduce, Reduce), ("norm", norm, Norm)):
        if value not in get_args(kind):
            raise ValueError(f"{name} must be one of {', '.join(get_args(kind))}, got {value!r}")
    if chunk < 1:
        raise ValueError(f"chunk must be at least 1, got {chunk}")
    policy, scalars = policy_of(model), outputs(model, target)
    with evaluation(policy), torch.enable_grad():
        features = encode_frames(policy.encode, frames, chunk, dtype)
        jacobian, output = memory_jacobian(policy, scalars, features, last_action, is_init, state, reduce)
        pixels, totals = frame_norms(policy.encode, frames, jacobian, norm, chunk, dtype, maps)
    return pixels, totals, output


def _window(frames: Tensor, last_action: Tensor | None, is_init: Tensor | None, n: int) -> tuple[int, Tensor, Tensor]:
    """Number of frames that matter, and the other inputs cut to them."""
    if frames.ndim != 4:
        raise ValueError(f"frames must have shape [T, H, W, C], got {list(frames.shape)}")
    total = frames.shape[0]
    if not -total <= n < total:
        raise ValueError(f"n = {n} is outside a window of {total} frames")
    steps = n % total + 1
    device = frames.device
    actions = torch.zeros(total, dtype=torch.int64, device=device) if last_action is None else last_action.reshape(-1)
    starts = torch.zeros(total, dtype=torch.bool, device=device) if is_init is None else is_init.reshape(-1)
    for name, value in (("last_action", actions), ("is_init", starts)):
        if value.shape[0] != total:
            raise ValueError(f"{name} must have one entry a frame ({total}), got {value.shape[0]}")
    return steps, actions[:steps], starts[:steps].bool()
