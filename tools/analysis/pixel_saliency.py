"""Pixel saliency: how the decision at step n depends on every pixel seen at steps t <= n.

``S(o_t) = sum_a || d Q(s_n, a) / d o_t ||^2``, the norm taken over colour channels at each pixel.

Computed in two stages. The encoder works frame by frame, so the memory and the head are differentiated once, with
respect to the features (giving J, actions x steps x features), and J is then pushed through the encoder in chunks of
frames. The cost is one encoder backward pass for each frame and action, whatever the memory model.

Source: POPGym Arcade (ICML 2026), pixel saliency; the reference implementation differentiates the sum over actions
instead (``reduce="sum", norm="l1"``, divided by 3).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Reduce = Literal["per_action", "sum"]
Norm = Literal["l2sq", "l2", "l1"]
Target = Literal["q", "logits", "probs", "value"]
Encode = Callable[[Tensor], Tensor]
Remember = Callable[[Tensor, Tensor, Tensor, Any], tuple[Tensor, Any]]


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
    target: Target = "q",
    chunk: int = 16,
    dtype: torch.dtype = torch.float32,
) -> Saliency:
    """Gradient of the outputs at step n with respect to every frame up to n.

    Args:
        model: an agent with an attribute ``network``, a network with ``encode``, ``remember`` and ``initial_state``,
            or a pair ``(encode, remember)``: ``encode(frames [T, H, W, C]) -> features [T, E]`` and
            ``remember(features [B, T, E], last_action [B, T], is_init [B, T], state) -> (out [B, T, A], state)``.
        frames: uint8 or float [T, H, W, C], values 0 to 255: what the agent saw, oldest first.
        last_action: int64 [T], the action that led to each frame; zeros by default.
        is_init: bool [T] or [T, 1], whether a frame opens an episode; all false by default.
        state: recurrent state before the first frame, batch of one; the model's initial state by default.
        n: index of the step to explain, negative from the end.
        reduce: ``per_action`` (the paper: norms of single actions, summed) or ``sum`` (norm of the gradient of the sum
            over actions, in which opposite effects cancel).
        norm: ``l2sq``, ``l2`` or ``l1``, over the channels of a pixel for ``maps``, over the frame for ``per_frame``.
        target: ``q`` and ``logits`` differentiate the outputs as they are, ``probs`` their softmax, ``value`` their
            maximum (for a network with a single output, that output).
        chunk: frames pushed through the encoder at once; bounds memory.
        dtype: of frames and gradients, float32 or float64 (the model's parameters must match).

    Returns:
        Maps and sums as numpy arrays.

    Raises:
        ValueError: a shape does not fit, n is out of range, or an option has an unknown value.
        TypeError: ``model`` has none of the forms above.
    """
    for name, value, kind in (("reduce", reduce, Reduce), ("norm", norm, Norm), ("target", target, Target)):
        if value not in get_args(kind):
            raise ValueError(f"{name} must be one of {', '.join(get_args(kind))}, got {value!r}")
    steps, last_action, is_init = _window(frames, last_action, is_init, n)
    if chunk < 1:
        raise ValueError(f"chunk must be at least 1, got {chunk}")
    encode, remember, initial = _parts(model)
    with _evaluation(model), torch.enable_grad():
        pixels = frames[:steps].to(dtype)
        with torch.no_grad():
            features = torch.cat([encode(part) for part in pixels.split(chunk)])
        cotangents, output = _memory_stage(remember, initial, features, last_action, is_init, state, reduce, target)
        maps, totals = _encoder_stage(encode, pixels, cotangents, norm, chunk)
    return Saliency(
        maps.to(torch.float32).cpu().numpy(),
        totals.double().cpu().numpy(),
        output.float().cpu().numpy(),
        steps - 1,
        reduce,
        norm,
        target,
    )


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


def _parts(model: Any) -> tuple[Encode, Remember, Callable[[int], Any]]:
    if isinstance(model, tuple) and len(model) == 2 and all(callable(part) for part in model):
        return model[0], model[1], lambda batch_size: None
    network = getattr(model, "network", model)
    if all(hasattr(network, name) for name in ("encode", "remember", "initial_state")):
        return network.encode, network.remember, network.initial_state
    raise TypeError(
        "model must be an agent, a network with encode and remember, or a pair (encode, remember), "
        f"got {type(model).__name__}"
    )


class _evaluation:
    """Put a module into evaluation mode, and back."""

    def __init__(self, model: Any) -> None:
        network = getattr(model, "network", model)
        self.network = network if isinstance(network, torch.nn.Module) else None

    def __enter__(self) -> None:
        self.training = self.network is not None and self.network.training
        if self.network is not None:
            self.network.eval()

    def __exit__(self, *exc: object) -> None:
        if self.network is not None and self.training:
            self.network.train()


def _memory_stage(
    remember: Remember,
    initial: Callable[[int], Any],
    features: Tensor,
    last_action: Tensor,
    is_init: Tensor,
    state: Any,
    reduce: Reduce,
    target: Target,
) -> tuple[Tensor, Tensor]:
    """Gradients of the outputs at the last step with respect to the features, [A', T, E], and those outputs [A].

    One copy of the window for each output stands in the batch, so that a single backward pass gives all rows of J with
    any memory model, without batching rules for its operators.
    """
    if state is None:
        state = initial(1)
    with torch.no_grad():
        raw, _ = remember(features[None], last_action[None], is_init[None], state)
        count = 1 if reduce == "sum" else _outputs(raw[:, -1], target).shape[-1]
    leaf = features.expand(count, *features.shape).clone().requires_grad_()
    out, _ = remember(
        leaf, last_action.expand(count, -1), is_init.expand(count, -1), None if state is None else _repeat(state, count)
    )
    outputs = _outputs(out[:, -1], target)
    scalar = outputs.sum() if reduce == "sum" else outputs.diagonal().sum()
    (gradient,) = torch.autograd.grad(scalar, leaf, allow_unused=True)
    gradient = torch.zeros_like(leaf) if gradient is None else gradient
    return gradient.detach(), outputs[0].detach()


def _outputs(raw: Tensor, target: Target) -> Tensor:
    if target == "probs":
        return raw.softmax(-1)
    if target == "value":
        return raw.amax(-1, keepdim=True)
    return raw


def _repeat(state: Any, count: int) -> Any:
    """A batch of equal states; TensorDicts and tensors both know ``expand``."""
    if hasattr(state, "batch_size"):
        return state.reshape(1).expand(count).clone()
    return state.expand(count, *state.shape[1:])


def _encoder_stage(encode: Encode, pixels: Tensor, cotangents: Tensor, norm: Norm, chunk: int) -> tuple[Tensor, Tensor]:
    """Push J through the encoder chunk by chunk and reduce at once: maps [T, H, W] and sums [T]."""
    maps, totals = [], []
    for start in range(0, pixels.shape[0], chunk):
        part = pixels[start : start + chunk].detach().requires_grad_()
        features = encode(part)
        pixel_sum, frame_sum = torch.zeros_like(part[..., 0]), torch.zeros_like(part[:, 0, 0, 0])
        for row in cotangents[:, start : start + chunk]:
            (gradient,) = torch.autograd.grad(
                features, part, row.to(features.dtype), retain_graph=True, allow_unused=True
            )
            if gradient is not None:
                per_pixel, per_frame = _norms(gradient, norm)
                pixel_sum, frame_sum = pixel_sum + per_pixel, frame_sum + per_frame
        maps.append(pixel_sum.detach())
        totals.append(frame_sum.detach())
    return torch.cat(maps), torch.cat(totals)


def _norms(gradient: Tensor, norm: Norm) -> tuple[Tensor, Tensor]:
    """Norm over channels [T, H, W] and over whole frames [T] of gradients [T, H, W, C]."""
    if norm == "l1":
        per_pixel = gradient.abs().sum(-1)
        return per_pixel, per_pixel.sum((1, 2))
    squares = gradient.square().sum(-1)
    if norm == "l2sq":
        return squares, squares.sum((1, 2))
    return squares.sqrt(), squares.sum((1, 2)).sqrt()
