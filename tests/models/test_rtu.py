"""Recurrent trace units are the paper's equations in real numbers; their numbers are pinned."""

import pytest
import torch
from torch import Tensor

from arcade_torch.models import make_memory
from tests.models.written_out import F64, assert_is_written_out, pinned_pass, problem


def test_it_is_the_papers_equations_in_real_numbers() -> None:
    memory, x, state, is_init = problem("rtu")
    r = torch.exp(-memory.nu.exp())
    theta = memory.theta.exp()
    g = r * torch.cos(theta)
    p = r * torch.sin(theta)
    norm = torch.sqrt(1 - r**2)

    def step(x: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        a, b = state["h"].unbind(-1)
        new_a = g * a - p * b + norm * (memory.input[:, 0] @ x)
        new_b = g * b + p * a + norm * (memory.input[:, 1] @ x)
        h = torch.stack([new_a, new_b], dim=-1)
        return memory.output(torch.relu(h.flatten())), {"h": h}

    assert_is_written_out(memory, x, state, is_init, step)


def test_its_states_are_those_of_an_lru_whose_scale_follows_its_radius() -> None:
    rtu = make_memory("rtu", 3, 8).to(F64)
    lru = make_memory("lru", 3, 8).to(F64)
    with torch.no_grad():
        for name in ("nu", "theta", "input"):
            getattr(lru, name).copy_(getattr(rtu, name))
        lru.gamma.copy_(0.5 * torch.log(1 - torch.exp(-2 * rtu.nu.exp())))
    x = torch.randn(2, 9, 3, dtype=F64)
    is_init = torch.rand(2, 9) < 0.3
    _, ours = rtu(x, rtu.initial_state(2), is_init)
    _, theirs = lru(x, lru.initial_state(2), is_init)
    torch.testing.assert_close(ours["h"], theirs["h"], rtol=0, atol=1e-12)


def test_the_scale_is_right_where_a_radius_rounds_to_one() -> None:
    memory = make_memory("rtu", 1, 1)
    with torch.no_grad():
        memory.nu.fill_(-20.0)  # r = 1 - 2e-9
        memory.input.fill_(1.0)
    _, state = memory(
        torch.ones(1, 1, 1), memory.initial_state(1), torch.ones(1, 1, dtype=torch.bool)
    )
    expected = (2 * torch.exp(torch.tensor(-20.0))).sqrt()
    torch.testing.assert_close(state["h"].flatten(), expected.expand(2), rtol=1e-5, atol=0)


def test_radii_out_of_range_are_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^need 0 <= r_min < r_max <= 1, got r_min=0.9, r_max="):
        make_memory("rtu", 3, 4, r_min=0.9, r_max=0.5)


def test_one_forward_pass_is_pinned() -> None:
    y = pinned_pass("rtu")
    torch.testing.assert_close(y, torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-7)


PINNED = [[-1.21332226, -1.04314118], [-1.95419421, 0.33218288], [-1.47081167, -0.05942080]]
"""Of NumPy, one step at a time."""
