"""For the tests that write a memory's equations out, one step after the other."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models import make_memory

F64 = torch.float64
Step = Callable[[Tensor, dict[str, Tensor]], tuple[Tensor, dict[str, Tensor]]]
"""From an input [D] and the state before it, leaves without a batch, to the output and the state."""


def problem(
    name: str, sizes: tuple[int, int] = (3, 5), steps: int = 12, **options: object
) -> tuple[nn.Module, Tensor, TensorDict, Tensor]:
    """A model in float64 with every parameter random, inputs, a state some steps old, starts."""
    memory = make_memory(name, *sizes, **options).to(F64)
    with torch.no_grad():
        for parameter in memory.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    x = torch.randn(2, steps, sizes[0], dtype=F64)
    is_init = torch.zeros(2, steps, dtype=torch.bool)
    is_init[0, [0, 5]] = True
    is_init[1, 9] = True
    warm = torch.randn(2, 3, sizes[0], dtype=F64)
    with torch.no_grad():
        _, state = memory(warm, memory.initial_state(2), torch.zeros(2, 3, dtype=torch.bool))
    return memory, x, state, is_init


@torch.no_grad()
def assert_is_written_out(
    memory: nn.Module, x: Tensor, state: TensorDict, is_init: Tensor, step: Step
) -> None:
    """One call equals the steps, each row alone, to 1e-10 in outputs and states."""
    y, after = memory(x, state, is_init)
    for row in range(x.shape[0]):
        leaves = dict(state[row].items())
        for t in range(x.shape[1]):
            if is_init[row, t]:
                leaves = dict(memory.initial_state(1)[0].items())
            wanted, leaves = step(x[row, t], leaves)
            torch.testing.assert_close(y[row, t], wanted, rtol=0, atol=1e-10)
        for key, leaf in leaves.items():
            torch.testing.assert_close(after[key][row], leaf, rtol=0, atol=1e-10)


@torch.no_grad()
def pinned_pass(name: str, **options: object) -> Tensor:
    """Outputs [3, 2] of a model of width 2 whose parameters and inputs are sines and cosines."""
    memory = make_memory(name, 2, 2, **options).to(F64)
    for number, parameter in enumerate(memory.parameters(), 1):
        places = torch.arange(parameter.numel(), dtype=F64)
        parameter.copy_(torch.sin(number + places).view_as(parameter))
    x = torch.cos(torch.arange(6, dtype=F64)).view(1, 3, 2)
    y, _ = memory(x, memory.initial_state(1), torch.zeros(1, 3, dtype=torch.bool))
    return y[0]


def file_of(package: str, path: str) -> ModuleType:
    """A file of a package that is installed, on its own: what stands around it needs more than is
    here, as Triton for flash-linear-attention (``fla-core``). The test is skipped without it, but
    in `make test-suites`, which installs it.
    """
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        assert "SUITES_ARE_THERE" not in os.environ, f"the package of {package} is not installed"
        pytest.skip(f"the package of {package} is not installed")
    file = Path(next(iter(found.submodule_search_locations))) / path
    spec = importlib.util.spec_from_file_location(f"file_of_{package}", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
