"""Memory models on a GPU: the numbers of the CPU, values and gradients, over sequences and step by
step.
"""

import copy
from typing import Any

import pytest
import torch
from torch import Tensor

from arcade_torch.models import make_memory, memory_names

pytestmark = pytest.mark.gpu
TOLERANCE = {torch.float32: 5e-4, torch.float64: 1e-9}


def run(memory: Any, x: Tensor, is_init: Tensor) -> list[Tensor]:
    """Outputs, the last state, and gradients of the input and of all parameters; on the CPU."""
    device = next(memory.parameters()).device
    inputs = [x.to(device).requires_grad_(), *(p for p in memory.parameters() if p.requires_grad)]
    y, state = memory(inputs[0], memory.initial_state(len(x)), is_init.to(device))
    weight = torch.linspace(-1, 1, y.numel(), dtype=y.dtype, device=device).reshape(y.shape)
    found = torch.autograd.grad((y * weight).sum(), inputs, allow_unused=True)
    leaves = [value for _, value in sorted(state.items(True, True), key=lambda item: str(item[0]))]
    return [value.detach().cpu() for value in (y, *leaves, *found) if value is not None]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", memory_names())
def test_a_memory_computes_on_a_card_what_it_computes_on_the_cpu(
    name: str, dtype: torch.dtype, device: str
) -> None:
    here = make_memory(name, 12, 16).to(dtype)
    there = copy.deepcopy(here).to(device)
    x, is_init = torch.randn(3, 70, 12, dtype=dtype), torch.rand(3, 70) < 0.05
    for mine, theirs in zip(run(here, x, is_init), run(there, x, is_init), strict=True):
        if mine.is_floating_point():
            scale = max(1.0, float(mine.abs().max()))
            torch.testing.assert_close(theirs / scale, mine / scale, rtol=0, atol=TOLERANCE[dtype])
        else:
            assert torch.equal(theirs, mine)


@pytest.mark.parametrize("name", memory_names())
def test_acting_step_by_step_on_a_card_gives_what_the_sequence_gives(
    name: str, device: str
) -> None:
    memory: Any = make_memory(name, 12, 16).to(device)
    x, is_init = torch.randn(3, 40, 12, device=device), (torch.rand(3, 40) < 0.05).to(device)
    with torch.no_grad():
        whole = memory(x, memory.initial_state(3), is_init)[0]
        state, steps = memory.initial_state(3), []
        for t in range(40):
            y, state = memory(x[:, t : t + 1], state, is_init[:, t : t + 1])
            steps.append(y)
    torch.testing.assert_close(torch.cat(steps, 1), whole, rtol=1e-3, atol=1e-4)
