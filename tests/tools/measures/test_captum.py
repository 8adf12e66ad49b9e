"""Captum on our agents and on any policy: its gradients are ours, its methods run, and a state is
attributed beside the frame.

Without Captum the same equalities hold for gradients taken by hand.
"""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from arcade_torch.agents import Agent, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.models import memory_names
from arcade_torch.models.flat_state import flatten_state, unflatten_state
from arcade_torch.tools import as_policy, saliency
from tests.tools.measures.test_any_policy import MEMORIES, module
from tests.tools.measures.toys import frames

STEPS = 3
STARTS = torch.tensor([[True, False, False]])
ACTED = torch.tensor([[0, 2, 4]])


def agent_of(algorithm: str, memory: str = "lru") -> Agent:
    config = preset("smoke", memory=memory, algorithm=algorithm)
    agent = Agent(config, build_network(config))
    return agent.train()  # what is measured is in evaluation mode all the same


def seen(agent: Agent) -> Tensor:
    size = agent.config.obs_size
    generator = torch.Generator().manual_seed(0)
    shape = (1, STEPS, size, size, 3)
    return torch.randint(256, shape, generator=generator, dtype=torch.uint8)


def by_hand(forward: Any, inputs: Tensor) -> Tensor:
    """The gradients of each output by the inputs, [A, N, ...]."""
    leaf = inputs.clone().requires_grad_()
    outputs = forward(leaf)
    rows = [torch.autograd.grad(out.sum(), leaf, retain_graph=True)[0] for out in outputs.unbind(1)]
    return torch.stack(rows)


def assert_equal_maps(maps: np.ndarray, gradients: Tensor) -> None:
    """L1 maps [T, H, W] equal gradients [A, 1, T, H, W, C] to 1e-5 of the largest."""
    wanted = gradients.abs().sum((0, -1))[0].numpy()
    np.testing.assert_allclose(maps, wanted, rtol=1e-4, atol=1e-5 * wanted.max())


@pytest.mark.parametrize("target", ["auto", "value"])
@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_gradients_of_forward_frames_are_our_saliency(algorithm: str, target: Any) -> None:
    agent = agent_of(algorithm)
    forward = partial(agent.forward_frames, last_action=ACTED, is_init=STARTS, target=target)
    pixels = seen(agent)
    ours = saliency(agent, pixels[0], ACTED[0], STARTS[0], norm="l1", target=target)
    np.testing.assert_allclose(forward(pixels.float())[0].detach(), ours.output, rtol=1e-5)
    assert_equal_maps(ours.maps, by_hand(forward, pixels.float()))
    assert agent.training and all(part.training for part in agent.modules())


@pytest.mark.parametrize("memory", memory_names())
def test_a_frame_and_the_state_before_it_give_what_the_frames_give(memory: str) -> None:
    agent = agent_of("pqn", memory)
    pixels = seen(agent).float()
    whole = agent.forward_frames(pixels, ACTED, STARTS)
    with torch.no_grad():
        state = agent.eval().initial_state(1)
        features = agent.network.encode(pixels)
        for t in range(STEPS - 1):
            step = slice(t, t + 1)
            _, state = agent.network.remember(
                features[:, step], ACTED[:, step], STARTS[:, step], state
            )
    one = agent.forward_step(pixels[:, -1], state, ACTED[:, -1])
    torch.testing.assert_close(one, whole, rtol=1e-4, atol=1e-5)
    flat = agent.flat_state(state)
    assert flat.ndim == 2 and not flat.is_complex()
    again = agent.forward_step(pixels[:, -1], flat, ACTED[:, -1])
    torch.testing.assert_close(again, one, rtol=1e-5, atol=1e-6)
    back = unflatten_state(flat, state)
    assert all(torch.equal(back[key], state[key]) for key in state.keys(True, True))
    if memory != "mlp":
        flat.requires_grad_()
        out = agent.forward_step(pixels[:, -1], flat, ACTED[:, -1])
        assert torch.autograd.grad(out.sum(), flat)[0].any()


@pytest.mark.parametrize("memory", MEMORIES)
def test_any_policy_has_the_same_two_functions(memory: str) -> None:
    policy = as_policy(module(memory))
    pixels = frames(4)[None].float()
    features = policy.features(pixels, batch_ndim=2)
    whole = policy.forward_frames(pixels)
    _, state = policy.unroll(features[:, :-1])
    torch.testing.assert_close(policy.forward_step(pixels[:, -1], state), whole)
    flat = flatten_state(state)
    torch.testing.assert_close(policy.forward_step(pixels[:, -1], flat), whole)
    ours = saliency(policy, pixels[0], norm="l1")
    assert_equal_maps(ours.maps, by_hand(policy.forward_frames, pixels))


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_captums_saliency_is_ours(algorithm: str) -> None:
    attr = pytest.importorskip("captum.attr")
    agent = agent_of(algorithm)
    pixels = seen(agent).float()
    gradients = []
    for action in range(5):
        method = attr.Saliency(agent.forward_frames)
        inputs = pixels.clone().requires_grad_()
        extra = (ACTED, STARTS)
        gradients.append(method.attribute(inputs, action, additional_forward_args=extra))
    ours = saliency(agent, pixels[0], ACTED[0], STARTS[0], norm="l1")
    assert_equal_maps(ours.maps, torch.stack(gradients).detach())


@pytest.mark.parametrize("kind", ["agent", "policy"])
def test_captums_other_methods_run(kind: str) -> None:
    attr = pytest.importorskip("captum.attr")
    if kind == "agent":
        agent = agent_of("ppo")
        forward = agent.forward_frames
        pixels = seen(agent).float()
        extra: Any = (ACTED, STARTS, agent.flat_state(agent.initial_state(1)))
        window = (1, 32, 32, 3)
    else:
        policy = as_policy(module("LSTMModule"))
        forward = policy.forward_frames
        pixels = frames(STEPS)[None].float()
        extra = None
        window = (1, 2, 2, 3)
    options = {"target": 1, "additional_forward_args": extra}

    integrated, error = attr.IntegratedGradients(forward).attribute(
        pixels, n_steps=24, internal_batch_size=4, return_convergence_delta=True, **options
    )
    black = forward(torch.zeros_like(pixels), *(extra or ()))[0, 1]
    moved = float(forward(pixels, *(extra or ()))[0, 1] - black)
    assert float(integrated.sum()) == pytest.approx(moved, rel=0.1, abs=1e-3)
    assert abs(float(error)) < 0.1 * abs(moved) + 1e-3

    occluded = attr.Occlusion(forward).attribute(pixels, window, strides=window, **options)
    assert occluded.shape == pixels.shape and occluded.any()
    noisy = attr.NoiseTunnel(attr.Saliency(forward)).attribute(
        pixels.requires_grad_(), nt_samples=2, stdevs=8.0, **options
    )
    assert noisy.shape == pixels.shape and noisy.any()


def test_captum_attributes_to_the_frame_and_to_the_state() -> None:
    attr = pytest.importorskip("captum.attr")
    agent = agent_of("pqn", "gru").eval()
    pixels = seen(agent).float()
    with torch.no_grad():
        _, state = agent.network.remember(
            agent.network.encode(pixels), ACTED, STARTS, agent.initial_state(1)
        )
    flat = agent.flat_state(state).requires_grad_()
    frame = pixels[:, -1].clone().requires_grad_()
    to_frame, to_state = attr.Saliency(agent.forward_step).attribute((frame, flat), target=2)
    assert to_frame.shape == frame.shape and to_state.shape == flat.shape
    assert to_frame.any() and to_state.any()
