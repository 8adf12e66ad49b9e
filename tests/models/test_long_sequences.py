"""Over 4,096 steps, and with large inputs, memories and their gradients stay finite and right."""

import pytest
import torch

from arcade_torch.models import make_memory

NAMES = ["ffm", "shm", "rtu", "deltaproduct", "rwkv7", "gru", "lstm"]
STEPS = 4096


@pytest.mark.parametrize("kind", ["large", "the same at every step"])
@pytest.mark.parametrize("name", NAMES)
def test_a_long_sequence_is_finite_forward_and_backward(name: str, kind: str) -> None:
    memory = make_memory(name, 4, 16)
    x = 100 * torch.randn(1, STEPS, 4)
    if kind != "large":
        x = torch.randn(1, 1, 4).expand(1, STEPS, 4).contiguous()
    x.requires_grad_()
    y, state = memory(x, memory.initial_state(1), torch.zeros(1, STEPS, dtype=torch.bool))
    assert y.isfinite().all() and state["h"].isfinite().all()
    y[:, -1].square().sum().backward()
    gradients = [x.grad, *(parameter.grad for parameter in memory.parameters())]
    assert all(gradient is None or gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_single_precision_stays_near_double_over_a_long_sequence(name: str) -> None:
    memory = make_memory(name, 4, 16)
    x = torch.randn(1, STEPS, 4)
    is_init = torch.zeros(1, STEPS, dtype=torch.bool)
    single, _ = memory(x, memory.initial_state(1), is_init)
    memory = memory.double()
    double, _ = memory(x.double(), memory.initial_state(1), is_init)
    assert (single - double).abs().max() < 2e-4 * double.abs().max()
