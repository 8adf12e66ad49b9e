"""Pixel saliency: how the decision at step n depends on every pixel seen at steps t <= n.

``S(o_t) = sum_a || d Q(s_n, a) / d o_t ||^2``, the norm taken over colour channels at each pixel.

Computed in two stages of ``torch.autograd``, as the encoder works frame by frame: memory and head
are differentiated with respect to the features, which gives the Jacobian J [outputs, frames,
features]; then J is multiplied with the Jacobian of the encoder, some frames at a time. Memory use
is that of one chunk; frames whose rows of J are exactly zero are skipped.

Source: POPGym Arcade (ICML 2026), pixel saliency; the reference implementation differentiates the
sum over actions instead (``reduce="sum", norm="l1"``, divided by 3).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Unpack, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from arcade_torch.agents.checked import require, whole_from
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.models.arguments import is_whole
from arcade_torch.tools.measures.frames import as_array, channel_axis, float_type
from arcade_torch.tools.measures.keys import Names
from arcade_torch.tools.measures.masked import refuse_nan, refuse_no_action
from arcade_torch.tools.measures.policy import (
    Policy,
    Progress,
    Target,
    as_policy,
    outputs,
    resolve,
)
from arcade_torch.tools.measures.saliency.cuts import (
    outside_inference,
    refuse_cuts,
    refuse_infinite,
)
from arcade_torch.tools.measures.windows import MAX_STEPS, Twin, Window, greedy_window

Reduce = Literal["per_action", "sum"]
Norm = Literal["l2sq", "l2", "l1"]


@dataclass(frozen=True)
class Saliency:
    """The gradients that `saliency` gives."""

    # [n + 1, H, W], one map a frame; where the norm is additive, its pixels sum to per_frame; of
    # frames without channels [n + 1, *frame]
    maps: NDArray[np.float32]
    # [n + 1], of each frame the sum over actions of the norm over all pixels, channels
    per_frame: NDArray[np.float64]
    output: NDArray[np.float32]  # [A], what was differentiated, at step n
    n: int  # index of the step whose decision is explained
    target: str  # which output

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
    dtype: torch.dtype | None = None,
    **names: Unpack[Names],
) -> Saliency:
    """Gradient of the outputs at step n with respect to every frame up to n.

    Args:
        model: a TensorDict policy, an agent, or anything else that `as_policy` takes.
        frames: [T, H, W, C], [T, C, H, W] or any other shape, oldest first; a tensor or an array.
        last_action: [T], or one-hot [T, A], the action that led to each frame; zeros by default.
        is_init: bool [T] or [T, 1], whether a frame opens an episode; all false by default.
        state: recurrent state before the first frame, batch of one; by default the initial one.
        n: index of the step to explain, negative from the end.
        reduce: ``per_action`` (the paper: norms of single actions, summed) or ``sum`` (norm of the
            gradient of the sum over actions, in which opposite effects cancel).
        norm: ``l2sq``, ``l2`` or ``l1``, over channels for ``maps``, the frame for ``per_frame``.
        target: what is differentiated, see `outputs`: Q-values, or a policy's probabilities.
        chunk: frames pushed through the encoder at once; bounds memory.
        dtype: of frames and gradients; by default that of float frames, and float32 for others.
        **names: keywords of `as_policy`.

    Raises:
        ValueError: a shape does not fit, n is out of range, an option has an unknown value, or the
            policy says other things when it acts frame by frame, or cuts its gradients.
        TypeError: ``model`` has none of the forms above, or frames are no array.
    """
    policy = as_policy(model, **names)
    frames = _tensor("frames", frames)
    _check_options(reduce, norm, chunk, resolve(policy, target), dtype)
    dtype = dtype or float_type(frames)
    steps = _index(n, frames) + 1
    # what is computed in inference mode has no gradient, in silence
    with torch.inference_mode(False), torch.enable_grad(), policy.evaluating():
        actions = outside_inference(_last_actions(policy, last_action, frames)[:steps])
        starts = outside_inference(_starts(is_init, frames)[:steps])
        before = policy.initial_state(1) if state is None else outside_inference(_of_one(state))
        frames = outside_inference(frames[:steps])
        policy.check(frames, actions, starts, before, dtype)

        decide = _decision(policy, actions, starts, before, target)
        features = policy.features(frames, chunk, dtype).clone().requires_grad_()
        values, jacobian = _decided(decide, features, reduce)
        maps, sums = _frame_norms(policy, frames, jacobian, norm, chunk, dtype)
    return Saliency(
        maps=maps.float().cpu().numpy(),
        per_frame=sums.cpu().numpy(),
        output=values.float().cpu().numpy(),
        n=steps - 1,
        target=resolve(policy, target),
    )


def _check_options(reduce: str, norm: str, chunk: int, target: str, dtype: Any) -> None:
    """Refuse options of `saliency` that are unknown, out of range, or do not go together."""
    if (reduce, target) == ("sum", "probs"):
        raise ValueError(
            "the sum of all probabilities is always 1: take reduce per_action, or target logits"
        )
    check_norm(reduce, norm)
    whole_from(1, "chunk", chunk)
    is_float = isinstance(dtype, torch.dtype) and dtype.is_floating_point
    require(dtype is None or is_float, "dtype", dtype, "a floating one of torch")


def check_norm(reduce: str, norm: str) -> None:
    """Refuse an unknown norm, or way to put the actions together (ValueError)."""
    require(reduce in get_args(Reduce), "reduce", reduce, f"one of {', '.join(get_args(Reduce))}")
    require(norm in get_args(Norm), "norm", norm, f"one of {', '.join(get_args(Norm))}")


def _index(n: int, frames: Tensor) -> int:
    """The index of a frame, counted from the first; negative ``n`` count from the end."""
    require(frames.ndim > 1, "the shape of frames", list(frames.shape), "[T, H, W, C] or the like")
    total = frames.shape[0]
    require(is_whole(n), "n", n, "a whole number")
    require(-total <= n < total, "n", n, f"inside a window of {total} frames")
    return n % total


def _tensor(name: str, values: Any) -> Tensor:
    """A tensor as it is, and one of an array or a list of numbers."""
    if isinstance(values, Tensor):  # which `as_tensor` moves to torch's default device
        return values
    try:
        return torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be a tensor or an array; got {kind_of(values)}") from error


def _one_a_frame(name: str, given: Any, frames: Tensor) -> Tensor:
    """One value a frame, [T], or one-hot [T, A]."""
    values = _tensor(name, given)
    total = frames.shape[0]
    if values.ndim != 2 or values.shape[1] == 1:
        values = values.reshape(-1)
    require(len(values) == total, f"the length of {name}", len(values), f"that of frames, {total}")
    return values


def _last_actions(policy: Policy, last_action: Tensor | None, frames: Tensor) -> Tensor:
    """Last actions [T], or one-hot [T, A]; zeros where none are given."""
    if last_action is None:
        return policy.no_actions(frames.shape[:1], frames.device)
    return _one_a_frame("last_action", last_action, frames)


def _starts(is_init: Tensor | None, frames: Tensor) -> Tensor:
    """Start flags, bool [T]; all false by default."""
    if is_init is None:
        return torch.zeros(frames.shape[0], dtype=torch.bool, device=frames.device)
    return _one_a_frame("is_init", is_init, frames).bool()


def _of_one(state: Any) -> Any:
    """A state of a batch of one; a dictionary as a TensorDict."""
    if isinstance(state, Mapping) and not isinstance(state, TensorDictBase):
        state = TensorDict(dict(state), [1])
    size = list(state.batch_size if isinstance(state, TensorDictBase) else state.shape[:1])
    require(size == [1], "state", size, "of batch size [1]")
    return state


def _decision(
    policy: Policy, actions: Tensor, starts: Tensor, state: Any, target: Target
) -> Callable[[Tensor], Tensor]:
    """The outputs [A] of the last step as a function of the features [T, E]."""

    def decide(features: Tensor) -> Tensor:
        # a policy may change its state in place
        before = None if state is None else state.clone()
        out, _ = policy.remember(features[None], actions[None], starts[None], before)
        return outputs(policy, target)(out[:, -1])[0]

    return decide


def _decided(
    decide: Callable[[Tensor], Tensor], features: Tensor, reduce: Reduce
) -> tuple[Tensor, Tensor]:
    """The outputs [A] of a decision, and their Jacobian [K, T, E] by the features [T, E]."""
    values = decide(features)
    refuse_nan(values)
    refuse_no_action(values)
    jacobian = _jacobian(values, features, reduce)
    if reduce == "per_action":  # a sum over actions may rightly not change
        refuse_cuts(decide, features, jacobian.ne(0).any(-1).any(0))
    return values.detach(), jacobian


def _jacobian(values: Tensor, leaf: Tensor, reduce: Reduce) -> Tensor:
    """Jacobian [K, T, E] (K = 1 for "sum") of the outputs [A] by the features [T, E], of those that
    are finite: an action that is masked out is so whatever the frames are.
    """
    finite = values.isfinite()
    rows = finite.to(values)[None] if reduce == "sum" else finite.to(values).diag()[finite]
    return torch.stack([_gradient(values, leaf, row) for row in rows])


def _gradient(values: Tensor, leaf: Tensor, row: Tensor) -> Tensor:
    """The product of ``row`` with the Jacobian of the values by the leaf; zeros where they do not
    hang together.
    """
    if not values.requires_grad:
        return torch.zeros_like(leaf)
    (gradient,) = torch.autograd.grad(values, leaf, row, retain_graph=True, materialize_grads=True)
    return gradient


def _frame_norms(
    policy: Policy, frames: Tensor, jacobian: Tensor, norm: Norm, chunk: int, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Norms of the gradients by the frames, summed over the outputs: of pixels [T, H, W], and of
    whole frames [T].
    """
    shape = list(frames.shape)
    axis = channel_axis(shape[1:], policy.channels)
    axes = []  # that a pixel's norm is taken over
    if axis is not None:
        axes = [1 if axis == 0 else 3]
        shape.pop(axes[0])
    per_pixel = jacobian.new_zeros(shape, dtype=dtype)
    per_frame = jacobian.new_zeros(len(frames), dtype=torch.float64)
    needed = jacobian.ne(0).any(-1).any(0).nonzero().squeeze(-1)
    for index in needed.split(chunk) if len(needed) else ():
        part = frames[index].to(dtype).requires_grad_()
        features = policy.encode(part)
        reached = torch.zeros_like(index, dtype=torch.bool)
        for row in jacobian[:, index].to(features):
            # each frame's row as one of size 1: a small one vanishes in the product, and is no cut
            size = row.abs().amax(1, keepdim=True)
            gradient = _gradient(features, part, row / torch.where(size > 0, size, 1))
            reached |= gradient.ne(0).flatten(1).any(1)
            pixels = gradient.abs() if norm == "l1" else gradient.square()
            pixels = pixels.sum(axes) if axes else pixels
            total = pixels.flatten(1).sum(1, dtype=torch.float64)
            if norm == "l2":
                pixels = pixels.sqrt()
                total = total.sqrt()
            factor = size.squeeze(1).double() ** (2 if norm == "l2sq" else 1)
            per_frame[index] += total * factor
            per_pixel[index] += pixels * factor.to(dtype).reshape(-1, *[1] * (pixels.ndim - 1))
        refuse_cuts(policy.encode, part, reached)
    refuse_infinite(per_frame)
    return per_pixel, per_frame


@dataclass(frozen=True)
class EpisodeSaliency(Saliency):
    """Saliency of the last decision of an episode, with what was seen and done."""

    frames: NDArray[Any]  # [n + 1, *frame], of our games uint8 [n + 1, H, W, 3]
    action: NDArray[np.int64]  # [n + 1], chosen on each frame


def episode_saliency(
    agent: Any,
    env: Any = None,
    *,
    seed: int = 0,
    max_steps: int = MAX_STEPS,
    show: int = 1,
    tries: int = 1,
    observability: Twin | None = None,
    reduce: Reduce = "per_action",
    norm: Norm = "l2sq",
    target: Target = "auto",
    progress: Progress | None = None,
    **names: Unpack[Names],
) -> EpisodeSaliency:
    """Saliency of the last decision of a greedy episode, in ``env`` or in the agent's own game, cut
    after ``max_steps``.

    At most ``tries`` episodes are played, from ``seed`` on, until one has the ``show`` frames that
    are wanted; else the longest counts. All else is as for `greedy_window` and `saliency`;
    ``progress`` is called once, with (1, 1).
    """
    windows: list[Window] = []
    for episode_seed in range(seed, seed + tries):
        window = greedy_window(
            agent,
            env,
            seed=episode_seed,
            observability=observability,
            max_steps=max_steps,
            **names,
        )
        windows.append(window)
        if window.n + 1 >= show:
            break
    longest = max(windows, key=lambda window: window.n)
    result = saliency(
        agent,
        longest.frames,
        longest.last_action,
        longest.is_init,
        longest.state,
        reduce=reduce,
        norm=norm,
        target=target,
        **names,
    )
    if progress is not None:
        progress(1, 1)
    return EpisodeSaliency(
        **vars(result), frames=as_array(longest.frames), action=longest.action.cpu().numpy()
    )
