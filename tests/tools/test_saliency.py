"""Saliency of models whose gradients are known, and of the real memory models against plain differentiation."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from arcade_torch.models import make_memory, memory_names
from arcade_torch.tools import saliency
from arcade_torch.tools.analysis.pixel_saliency import Saliency

SIZE, FEATURES, ACTIONS = 4, 6, 3
F64 = torch.float64


def linear_model(rho: float, seed: int = 0) -> tuple[Callable[..., Any], Callable[..., Any], Tensor, Tensor]:
    """e_t = C o_t, h_t = rho h_{t-1} + e_t, q_a = w_a . h_n, and the matrices C and w."""
    generator = torch.Generator().manual_seed(seed)
    encoder = torch.randn(FEATURES, SIZE * SIZE * 3, generator=generator, dtype=F64)
    head = torch.randn(ACTIONS, FEATURES, generator=generator, dtype=F64)

    def encode(frames: Tensor) -> Tensor:
        return frames.flatten(-3) @ encoder.T

    def remember(features: Tensor, last_action: Tensor, is_init: Tensor, state: Any) -> tuple[Tensor, Any]:
        hidden, outputs = torch.zeros_like(features[:, 0]), []
        for t in range(features.shape[1]):
            hidden = rho * torch.where(is_init[:, t, None], 0.0, hidden) + features[:, t]
            outputs.append(hidden @ head.T)
        return torch.stack(outputs, 1), None

    return encode, remember, encoder, head


def frames(steps: int, seed: int = 0) -> Tensor:
    return torch.randint(256, (steps, SIZE, SIZE, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


@given(rho=st.floats(0.1, 1.0), steps=st.integers(1, 12), chunk=st.integers(1, 5))
def test_a_linear_model_has_the_closed_form(rho: float, steps: int, chunk: int) -> None:
    encode, remember, encoder, head = linear_model(rho)
    gradient = (head @ encoder).reshape(ACTIONS, SIZE, SIZE, 3)  # dQ_a/do_n
    decay = torch.tensor([rho ** (steps - 1 - t) for t in range(steps)], dtype=F64)
    wanted = {
        "l1": (gradient.abs().sum((0, 3)), gradient.abs().sum(), decay),
        "l2sq": (gradient.square().sum((0, 3)), gradient.square().sum(), decay**2),
        "l2": (gradient.square().sum(3).sqrt().sum(0), gradient.square().sum((1, 2, 3)).sqrt().sum(), decay),
    }
    for norm, (per_pixel, total, factor) in wanted.items():
        found = saliency((encode, remember), frames(steps), norm=norm, chunk=chunk, dtype=F64)
        np.testing.assert_allclose(found.per_frame, (factor * total).numpy(), rtol=1e-9)
        np.testing.assert_allclose(found.maps, (factor[:, None, None] * per_pixel).numpy(), rtol=1e-5)


def test_shares_follow_the_geometric_series() -> None:
    rho, steps = 0.7, 9
    encode, remember, _, _ = linear_model(rho)
    found = saliency((encode, remember), frames(steps), norm="l1", dtype=F64)
    wanted = [rho ** (steps - 1 - t) * (1 - rho) / (1 - rho**steps) for t in range(steps)]
    np.testing.assert_allclose(found.shares(), wanted, rtol=1e-9)


def test_without_memory_only_the_last_frame_counts() -> None:
    encode, remember, _, _ = linear_model(0.0)
    found = saliency((encode, remember), frames(6), dtype=F64)
    assert found.shares()[-1] == 1.0
    assert not found.maps[:-1].any()


def test_nothing_leaks_over_a_start_flag() -> None:
    encode, remember, _, _ = linear_model(0.9)
    starts = torch.tensor([True, False, False, True, False, False])
    found = saliency((encode, remember), frames(6), is_init=starts, dtype=F64)
    assert not found.maps[:3].any()
    assert (found.per_frame[3:] > 0).all()


def test_any_step_can_be_explained_and_later_frames_do_not_matter() -> None:
    encode, remember, _, _ = linear_model(0.8)
    whole, cut = frames(7), frames(7)[:4]
    early, same = (saliency((encode, remember), o, n=n, dtype=F64) for o, n in ((whole, 3), (cut, -1)))
    assert early.n == same.n == 3 and early.maps.shape == (4, SIZE, SIZE)
    np.testing.assert_array_equal(early.maps, same.maps)


def test_opposite_effects_cancel_in_the_sum_but_not_per_action() -> None:
    def encode(o: Tensor) -> Tensor:
        return o.flatten(-3).sum(-1, keepdim=True)

    def remember(e: Tensor, a: Tensor, s: Tensor, state: Any) -> tuple[Tensor, Any]:
        return torch.cat([e, -e], -1), None  # Q_0 = +x, Q_1 = -x

    assert saliency((encode, remember), frames(1), reduce="sum", norm="l1", dtype=F64).per_frame == 0
    assert saliency((encode, remember), frames(1), norm="l1", dtype=F64).per_frame == 2 * SIZE * SIZE * 3


def test_probabilities_of_two_actions_weigh_all_frames_alike() -> None:
    encode, remember, _, _ = linear_model(0.8)

    def tame(o: Tensor) -> Tensor:
        return encode(o) / 1e4

    def two(e: Tensor, a: Tensor, s: Tensor, state: Any) -> tuple[Tensor, Any]:
        z = remember(e, a, s, state)[0][..., :1]
        return torch.cat([z, torch.zeros_like(z)], -1), None

    logits = saliency((tame, two), frames(6), norm="l1", target="logits", dtype=F64)
    probs = saliency((tame, two), frames(6), norm="l1", target="probs", dtype=F64)
    np.testing.assert_allclose(probs.shares(), logits.shares(), rtol=1e-9)
    p = float(torch.tensor(logits.output, dtype=F64).softmax(-1)[0])
    np.testing.assert_allclose(probs.per_frame, 2 * p * (1 - p) * logits.per_frame, rtol=1e-5)


class Net(nn.Module):
    """A small real network: convolution, one of our memory models, a linear head."""

    def __init__(self, name: str, dtype: torch.dtype = F64) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.convolution = nn.Conv2d(3, 2, 2, 2)
        self.memory = make_memory(name, 2 * (SIZE // 2) ** 2 + ACTIONS, 5)
        self.head = nn.Linear(5, ACTIONS)
        self.to(dtype)

    def encode(self, o: Tensor) -> Tensor:
        x = (o / 255).movedim(-1, -3).reshape(-1, 3, SIZE, SIZE)
        return torch.tanh(self.convolution(x)).flatten(1).reshape(*o.shape[:-3], -1)

    def remember(self, e: Tensor, last_action: Tensor, is_init: Tensor, state: Any) -> tuple[Tensor, Any]:
        acted = torch.nn.functional.one_hot(last_action, ACTIONS).to(e.dtype)
        y, state = self.memory(torch.cat([e, acted], -1), state, is_init)
        return self.head(y), state

    def initial_state(self, batch_size: int) -> Any:
        state = self.memory.initial_state(batch_size)
        wide = {torch.float32: torch.float64, torch.complex64: torch.complex128}
        return state.apply(lambda leaf: leaf.to(wide.get(leaf.dtype, leaf.dtype)))


def end_to_end(net: Net, o: Tensor, actions: Tensor, starts: Tensor) -> list[Tensor]:
    """dQ_a/do for every action, each by one backward pass through everything."""
    found = []
    for action in range(ACTIONS):
        leaf = o.to(F64).requires_grad_()
        out, _ = net.remember(net.encode(leaf)[None], actions[None], starts[None], net.initial_state(1))
        (gradient,) = torch.autograd.grad(out[0, -1, action], leaf)
        found.append(gradient)
    return found


@pytest.mark.parametrize("name", memory_names())
def test_two_stages_equal_plain_differentiation_and_finite_differences(name: str) -> None:
    net, steps = Net(name), 5
    o, actions = frames(steps).to(F64), torch.arange(steps) % ACTIONS
    starts = torch.tensor([True, False, False, False, False])
    found: Saliency = saliency(net, o, actions, starts, chunk=2, dtype=F64)
    gradients = end_to_end(net, o, actions, starts)
    wanted = torch.stack([gradient.square() for gradient in gradients]).sum((0, 4))
    np.testing.assert_allclose(found.maps, wanted.numpy(), rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(found.per_frame, wanted.sum((1, 2)).numpy(), rtol=1e-9, atol=1e-18)

    def value(shift: float) -> Tensor:
        moved = o.clone()
        moved[steps - 1, 1, 2, 0] += shift
        return net.remember(net.encode(moved)[None], actions[None], starts[None], net.initial_state(1))[0][0, -1]

    slope = (value(0.5) - value(-0.5)).detach()  # of the last frame, where every model has a gradient
    exact = torch.stack([gradient[steps - 1, 1, 2, 0] for gradient in gradients])
    np.testing.assert_allclose(slope.numpy(), exact.numpy(), rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("name", memory_names())
def test_real_models_see_nothing_before_a_start_flag(name: str) -> None:
    starts = torch.tensor([True, False, True, False])
    found = saliency(Net(name), frames(4).to(F64), None, starts, dtype=F64)
    assert not found.maps[:2].any()
    assert found.per_frame[3] > 0


def test_the_control_without_memory_sees_the_last_frame_only() -> None:
    found = saliency(Net("mlp"), frames(4).to(F64), dtype=F64)
    assert found.shares().tolist() == [0, 0, 0, 1]


def test_parameters_get_no_gradient_and_the_mode_is_kept() -> None:
    net = Net("gru").train()
    saliency(net, frames(3).to(F64), dtype=F64)
    assert net.training and all(parameter.grad is None for parameter in net.parameters())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"norm": "l3"}, "norm must be one of l2sq, l2, l1"),
        ({"reduce": "mean"}, "reduce must be one of per_action, sum"),
        ({"target": "v"}, "target must be one of q, logits, probs, value"),
        ({"n": 3}, "outside a window of 3 frames"),
        ({"chunk": 0}, "chunk must be at least 1"),
        ({"last_action": torch.zeros(2)}, "last_action must have one entry a frame"),
    ],
)
def test_bad_arguments_are_refused(options: dict[str, Any], message: str) -> None:
    encode, remember, _, _ = linear_model(0.5)
    with pytest.raises(ValueError, match=message):
        saliency((encode, remember), frames(3), dtype=F64, **options)
    with pytest.raises(TypeError, match="got object"):
        saliency(object(), frames(3))


def test_the_encoder_never_sees_more_than_one_chunk() -> None:
    encode, remember, _, _ = linear_model(0.9)
    sizes = []

    def counted(o: Tensor) -> Tensor:
        sizes.append(len(o))
        return encode(o)

    saliency((counted, remember), frames(9), chunk=4, dtype=F64)
    assert sizes == [4, 4, 1] * 2  # features, then gradients
