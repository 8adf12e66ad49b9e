"""Thousands of steps and large inputs: values and gradients stay finite, and right in single
precision.
"""

import pytest
import torch
from torch import Tensor, nn

from arcade_torch.models import make_memory

NAMES = ["s5", "mamba", "slstm", "mlstm", "gtrxl"]
OTHERS = ["ffm", "shm", "rtu", "deltaproduct", "rwkv7", "gru", "lstm"]
STEPS = 4096


def read(memory: nn.Module, x: Tensor) -> list[Tensor]:
    """Output, last state, and gradients of input and parameters."""
    x = x.requires_grad_()
    flags = torch.zeros(x.shape[:2], dtype=torch.bool)
    y, state = memory(x, memory.initial_state(len(x)), flags)
    leaves = [leaf for leaf in state.values() if leaf.is_floating_point()]
    gradients = torch.autograd.grad(y.square().mean(), [x, *memory.parameters()])
    return [y, *leaves, *gradients]


@pytest.mark.parametrize(
    ("name", "steps"),
    [
        *((name, STEPS) for name in NAMES if name != "slstm"),
        ("slstm", STEPS // 4),
        pytest.param("slstm", STEPS, marks=pytest.mark.slow),
    ],
)
def test_thousands_of_steps_in_single_precision_are_those_in_double(name: str, steps: int) -> None:
    memory = make_memory(name, 4, 8)
    x = torch.randn(1, steps, 4)
    single = read(memory, x.clone())
    double = read(memory.double(), x.double())
    for mine, right in zip(single, double, strict=True):
        assert (mine.double() - right).norm() <= 1e-4 * right.norm() + 1e-6


@pytest.mark.parametrize("size", [100.0, 10_000.0])
@pytest.mark.parametrize("name", NAMES)
def test_large_inputs_do_not_overflow(name: str, size: float) -> None:
    memory = make_memory(name, 4, 8)
    for value in read(memory, size * torch.randn(2, STEPS // 16, 4)):
        assert value.isfinite().all()


@pytest.mark.parametrize("gates", [(-30.0, -30.0), (30.0, -30.0), (300.0, 30.0), (-300.0, 30.0)])
@pytest.mark.parametrize("name", ["mlstm", "slstm"])
def test_shut_and_open_gates_do_not_overflow_over_thousands_of_steps(
    name: str, gates: tuple[float, float]
) -> None:
    """Inputs of exp(300), and a stabiliser that falls by 30 a step where nothing holds it."""
    memory = make_memory(name, 4, 8)
    with torch.no_grad():
        if name == "mlstm":
            memory.gates.bias.copy_(torch.tensor(gates))
        else:
            memory.from_input.bias[:8] = gates[0]
            memory.from_input.bias[8:16] = gates[1]
    for value in read(memory, torch.randn(1, STEPS // 4, 4)):
        assert value.isfinite().all()


@pytest.mark.parametrize("kind", ["large", "the same at every step"])
@pytest.mark.parametrize("name", OTHERS)
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


@pytest.mark.parametrize("name", OTHERS)
@torch.no_grad()
def test_single_precision_stays_near_double_over_a_long_sequence(name: str) -> None:
    memory = make_memory(name, 4, 16)
    x = torch.randn(1, STEPS, 4)
    is_init = torch.zeros(1, STEPS, dtype=torch.bool)
    single, _ = memory(x, memory.initial_state(1), is_init)
    memory = memory.double()
    double, _ = memory(x.double(), memory.initial_state(1), is_init)
    assert (single - double).abs().max() < 2e-4 * double.abs().max()
