"""Saliency beside the laws of `tests/tools/measures/test_laws.py`: maps, chunks, single steps, and
what is refused.
"""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from arcade_torch.agents import Agent, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.models import memory_names
from arcade_torch.tools import Policy, saliency
from arcade_torch.tools.measures.saliency.measure import episode_saliency
from tests.tools.measures.toys import ACTIONS, F64, SIZE, Net, frames, linear_policy, matrices


@given(rho=st.floats(0.1, 1.0), steps=st.integers(1, 12), chunk=st.integers(1, 5))
def test_a_linear_model_has_the_closed_form(rho: float, steps: int, chunk: int) -> None:
    encoder, head = matrices()
    gradient = (head @ encoder).reshape(ACTIONS, SIZE, SIZE, 3)  # dQ_a/do_n
    decay = torch.tensor([rho ** (steps - 1 - t) for t in range(steps)], dtype=F64)
    wanted = {
        "l1": (gradient.abs().sum((0, 3)), gradient.abs().sum(), decay),
        "l2sq": (gradient.square().sum((0, 3)), gradient.square().sum(), decay**2),
        "l2": (
            gradient.square().sum(3).sqrt().sum(0),
            gradient.square().sum((1, 2, 3)).sqrt().sum(),
            decay,
        ),
    }
    for norm, (per_pixel, total, factor) in wanted.items():
        found = saliency(linear_policy(rho), frames(steps), norm=norm, chunk=chunk, dtype=F64)
        np.testing.assert_allclose(found.per_frame, (factor * total).numpy(), rtol=1e-9)
        np.testing.assert_allclose(
            found.maps, (factor[:, None, None] * per_pixel).numpy(), rtol=1e-5
        )


def test_shares_follow_the_geometric_series_and_nothing_leaks_over_a_start_flag() -> None:
    rho, steps = 0.7, 9
    found = saliency(linear_policy(rho), frames(steps), norm="l1", dtype=F64)
    wanted = [rho ** (steps - 1 - t) * (1 - rho) / (1 - rho**steps) for t in range(steps)]
    np.testing.assert_allclose(found.shares(), wanted, rtol=1e-9)
    starts = torch.tensor([True, False, False, True, False, False])
    found = saliency(linear_policy(rho), frames(6), is_init=starts, dtype=F64)
    assert not found.maps[:3].any() and (found.per_frame[3:] > 0).all()


def test_any_step_can_be_explained_and_later_frames_do_not_matter() -> None:
    whole, cut = frames(7), frames(7)[:4]
    early, same = (
        saliency(linear_policy(0.8), o, n=n, dtype=F64) for o, n in ((whole, 3), (cut, -1))
    )
    assert early.n == same.n == 3 and early.maps.shape == (4, SIZE, SIZE)
    np.testing.assert_array_equal(early.maps, same.maps)


@pytest.mark.parametrize("name", memory_names())
def test_actions_and_starts_reach_the_memory_as_they_do_end_to_end(name: str) -> None:
    net, steps = Net(name), 5
    o, actions = frames(steps).to(F64), torch.arange(steps) % ACTIONS
    starts = torch.tensor([True, False, True, False, False])

    def remember(e: Tensor, last_action: Tensor, is_init: Tensor, state: Any) -> tuple[Tensor, Any]:
        return net.remember(e * (1 + last_action[..., None]), last_action, is_init, state)

    leaf = o.clone().requires_grad_()
    out, _ = remember(net.encode(leaf)[None], actions[None], starts[None], net.initial_state(1))
    gradients = [torch.autograd.grad(value, leaf, retain_graph=True)[0] for value in out[0, -1]]
    wanted = torch.stack(gradients).square().sum((0, 4))
    found = saliency(
        Policy(net.encode, remember, net.initial_state), o, actions, starts, chunk=2, dtype=F64
    )
    np.testing.assert_allclose(found.maps, wanted.numpy(), rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(found.per_frame, wanted.sum((1, 2)).numpy(), rtol=1e-9, atol=1e-18)
    assert not found.maps[:2].any() and found.per_frame[-1] > 0


def test_parameters_get_no_gradient_and_the_mode_is_kept() -> None:
    net = Net("gru").train()
    saliency(net, frames(3).to(F64), dtype=F64)
    assert net.training and all(parameter.grad is None for parameter in net.parameters())


def test_of_several_episodes_the_first_that_is_long_enough_is_explained_else_the_longest() -> None:
    config = preset("smoke", env="MineSweeperEasy", observability="partial", memory="gru")
    agent = Agent(config, build_network(config).eval())
    each = [episode_saliency(agent, seed=seed, max_steps=9) for seed in range(3)]
    assert all(
        one.maps.shape == one.frames.shape[:3] and len(one.action) == one.n + 1 for one in each
    )
    longest = episode_saliency(agent, max_steps=9, show=99, tries=3)
    assert longest.n == max(one.n for one in each)
    first = episode_saliency(agent, max_steps=9, show=1, tries=3)
    np.testing.assert_array_equal(first.frames, each[0].frames)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"norm": "l3"}, "norm must be one of l2sq, l2, l1"),
        ({"reduce": "mean"}, "reduce must be one of per_action, sum"),
        ({"target": "v"}, "target must be one of q, logits, probs, value"),
        ({"n": 3}, "n must be inside a window of 3 frames; got 3"),
        ({"chunk": 0}, "chunk must be at least 1"),
        ({"last_action": torch.zeros(2)}, "the length of last_action must be that of frames"),
    ],
)
def test_bad_arguments_are_refused(options: dict[str, Any], message: str) -> None:
    policy = linear_policy(0.5)
    with pytest.raises(ValueError, match=message):
        saliency((policy.encode, policy.remember), frames(3), dtype=F64, **options)
    with pytest.raises(TypeError, match="got object"):
        saliency(object(), frames(3))


def test_the_encoder_never_sees_more_than_one_chunk() -> None:
    policy, sizes = linear_policy(0.9), []

    def counted(o: Tensor) -> Tensor:
        sizes.append(len(o))
        return policy.encode(o)

    saliency((counted, policy.remember), frames(9), chunk=4, dtype=F64)
    # the first few alone and together, then features, then gradients
    assert sizes == [4, 1, 1, 1, 1, *[4, 4, 1] * 2]
