"""Saliency beside gradients in numpy: norms, channels, sums, states, and whole episodes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from arcade_torch.tools import saliency
from arcade_torch.tools.measures.saliency.measure import episode_saliency
from arcade_torch.tools.measures.windows import greedy_window
from tests.tools.measures.toys import ACTIONS, F64, FEATURES, SIZE, ToyEnv, linear_policy, matrices

Array = NDArray[np.float64]
RHO, STEPS = 0.7, 5
NORMS = ("l2sq", "l2", "l1")
SHAPE = (SIZE, SIZE, 3)


def gradients(shape: tuple[int, ...], reduce: str) -> Array:
    """Gradients [K, T, *shape] of the outputs, or of their sum, of `linear_policy`."""
    encoder, head = (matrix.numpy() for matrix in matrices())
    jacobian = head @ encoder
    if reduce == "sum":
        jacobian = jacobian.sum(0, keepdims=True)
    decay = RHO ** np.arange(STEPS - 1, -1, -1.0)
    found = decay[None, :, None] * jacobian[:, None]
    return found.reshape(len(jacobian), STEPS, *shape)


def norms(values: Array, norm: str, axes: Any) -> Array:
    """Norms over some axes, summed over the outputs."""
    if norm == "l1":
        return np.asarray(abs(values).sum(axes).sum(0))
    squares = (values**2).sum(axes)
    return np.asarray((squares if norm == "l2sq" else np.sqrt(squares)).sum(0))


@pytest.mark.parametrize("reduce", ["per_action", "sum"])
@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize(
    ("shape", "channel"), [(SHAPE, -1), ((3, SIZE, SIZE), -3), ((SIZE * SIZE * 3,), None)]
)
def test_maps_and_sums_are_norms_of_the_gradients(
    reduce: Any, norm: Any, shape: tuple[int, ...], channel: int | None
) -> None:
    frames = torch.rand(STEPS, *shape, dtype=F64)
    policy = linear_policy(RHO)
    flat = (lambda pixels: policy.encode(pixels.reshape(len(pixels), *SHAPE)), policy.remember)
    found = saliency(flat, frames, norm=norm, reduce=reduce)
    wanted = gradients(shape, reduce)
    axes = () if channel is None else channel
    np.testing.assert_allclose(found.maps, norms(wanted, norm, axes), rtol=1e-5)
    whole = tuple(range(2, wanted.ndim))
    np.testing.assert_allclose(found.per_frame, norms(wanted, norm, whole), rtol=1e-9)


def test_the_state_before_the_first_frame_counts() -> None:
    frames = torch.rand(STEPS, *SHAPE, dtype=F64)
    state = torch.randn(1, FEATURES, dtype=F64)
    _, head = matrices()
    policy = linear_policy(RHO)
    plain, moved = saliency(policy, frames), saliency(policy, frames, state=state)
    wanted = RHO**STEPS * (state @ head.T)[0].numpy()
    np.testing.assert_allclose(moved.output - plain.output, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("options", [{"norm": "l1"}, {"norm": "l2"}, {"reduce": "sum"}, {}])
def test_an_episode_is_explained_as_its_window_is(options: Any) -> None:
    policy = linear_policy(RHO, pixel_scale=255.0)
    window = greedy_window(policy, ToyEnv([STEPS]), seed=3)
    found = episode_saliency(policy, ToyEnv([STEPS]), seed=3, **options)
    same = saliency(policy, window.frames, window.last_action, window.is_init, **options)
    np.testing.assert_array_equal(found.maps, same.maps)
    np.testing.assert_array_equal(found.frames, window.frames.numpy())
    wanted = gradients(SHAPE, options.get("reduce", "per_action")) / 255
    per_frame = norms(wanted, options.get("norm", "l2sq"), (2, 3, 4))
    np.testing.assert_allclose(found.per_frame, per_frame, rtol=1e-5)
    assert len(found.output) == ACTIONS


def test_an_episode_is_explained_with_the_actions_that_were_taken() -> None:
    linear = linear_policy(RHO, pixel_scale=255.0)

    def remember(features: Any, last_action: Any, *others: Any) -> Any:
        return linear.remember(features * (1 + last_action[..., None]), last_action, *others)

    policy = replace(linear, remember=remember)
    found = episode_saliency(policy, ToyEnv([STEPS]), seed=3, norm="l1")
    led_by = np.append(0, found.action[:-1])
    assert led_by.any()
    per_frame = norms(gradients(SHAPE, "per_action") / 255, "l1", (2, 3, 4)) * (1 + led_by)
    np.testing.assert_allclose(found.per_frame, per_frame, rtol=1e-5)
