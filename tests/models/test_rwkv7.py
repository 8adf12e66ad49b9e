"""RWKV-7 is the paper's equations, and its operator the loop; its numbers are pinned."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from arcade_torch.models import make_memory
from arcade_torch.models.scan_dplr import dplr_loop, dplr_scan, dplr_scan_backward
from tests.models.written_out import (
    F64,
    assert_is_written_out,
    file_of,
    pinned_pass,
    problem,
)


def test_it_is_the_papers_equations() -> None:
    memory, x, state, is_init = problem("rwkv7", key_size=3)

    def step(x: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        mixed = torch.lerp(x.expand(6, -1), state["x"].expand(6, -1), memory.mix[:, 0])
        r, k, v, d, a, g = torch.einsum("pkd,pd->pk", memory.weight, mixed)
        w = torch.exp(-math.exp(-0.5) * torch.sigmoid(d + memory.bias))
        a = torch.sigmoid(a + memory.bias_a)
        kappa = k * memory.xi
        kappa = kappa / (kappa.norm() + 1e-6)
        k = k * torch.lerp(torch.ones_like(a), a, memory.alpha)
        s = state["h"].T  # the paper's, values by keys
        s = s @ (torch.diag(w) - torch.outer(kappa, a * kappa)) + torch.outer(v, k)
        p = memory.norm(s @ r) + (r @ (memory.rho * k)) * v
        return memory.output(torch.sigmoid(g) * p), {"h": s.T, "x": x}

    assert_is_written_out(memory, x, state, is_init, step)


def arguments(
    batch: int = 2, steps: int = 5, size: int = 3, resets: float = 0.3, each: bool = True
) -> list[Tensor]:
    """Random arguments of the scan, with a start at index 0."""
    w = torch.rand(batch, steps, size, dtype=F64, requires_grad=True)
    shapes = [(batch, steps, size)] * 3 + [(batch, steps, size + 1)]
    shapes.append((batch, steps if each else 1, size, size + 1))
    b, n, k, v, stored = (torch.randn(s, dtype=F64, requires_grad=True) for s in shapes)
    start = torch.rand(batch, steps) < resets
    start[:, 0] = True
    return [w, b, n, k, v, start, stored]


@given(
    batch=st.integers(1, 3),
    steps=st.integers(1, 9),
    size=st.integers(1, 4),
    resets=st.sampled_from([0.0, 0.2, 1.0]),
    each=st.booleans(),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=30, deadline=None)
def test_the_operator_equals_the_loop_values_and_gradients(
    batch: int, steps: int, size: int, resets: float, each: bool, seed: int
) -> None:
    torch.manual_seed(seed)
    given_ = arguments(batch, steps, size, resets, each)
    ours = dplr_scan(*given_)
    plain = dplr_loop(*given_)
    torch.testing.assert_close(ours, plain, rtol=1e-12, atol=1e-12)
    leaves = [x for x in given_ if x.requires_grad]
    direction = torch.randn_like(plain)
    gradients = torch.autograd.grad(ours, leaves, direction)
    wanted = torch.autograd.grad(plain, leaves, direction)
    torch.testing.assert_close(gradients, wanted, rtol=1e-9, atol=1e-10)


def test_opcheck_passes() -> None:
    given_ = arguments()
    torch.library.opcheck(dplr_scan, given_)
    with torch.no_grad():
        states = dplr_scan(*given_)
    detached = [x.detach() for x in given_]
    torch.library.opcheck(dplr_scan_backward, (*detached, states, torch.randn_like(states)))


def test_the_operator_is_the_recurrence_of_flash_linear_attention() -> None:
    """Its naive form of a diagonal plus low rank transition (fla-core 0.6.0), in float32."""
    pytest.importorskip("einops")
    naive = file_of("fla", "ops/generalized_delta_rule/dplr/naive.py")
    w, b, n, k, v, start, stored = (
        x.detach().float() if x.is_floating_point() else x for x in arguments(resets=0.0)
    )
    b = 0.3 * b
    _, wanted = naive.dplr_recurrence(
        *(x[:, None] for x in (n, k, v, -n, b, w.log())), initial_state=stored[:, :1]
    )
    states = dplr_scan(w, b, n, k, v, start, stored)
    torch.testing.assert_close(states[:, -1], wanted[:, 0], rtol=1e-5, atol=1e-5)


def test_a_size_that_is_not_positive_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^key_size must be positive, got 0$"):
        make_memory("rwkv7", 3, 4, key_size=0)


def test_one_forward_pass_is_pinned() -> None:
    y = pinned_pass("rwkv7", key_size=2)
    torch.testing.assert_close(y, torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-7)


PINNED = [[-0.80319972, 0.07075234], [0.02599145, -1.31928016], [-0.45553890, -1.13250460]]
"""Of NumPy, one step at a time."""
