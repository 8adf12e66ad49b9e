"""DeltaProduct is several delta rules a token; its numbers are pinned."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from arcade_torch.models import make_memory
from arcade_torch.models.scan_matrix import MatrixSteps
from tests.models.written_out import (
    F64,
    assert_is_written_out,
    file_of,
    pinned_pass,
    problem,
)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"householders": 1},
        {"householders": 3, "gate_alpha": False},
        {"householders": 2, "beta_range": 1.0},
    ],
)
def test_it_is_the_papers_equations(options: dict[str, object]) -> None:
    memory, x, state, is_init = problem("deltaproduct", key_size=3, **options)
    n = memory.householders

    def step(x: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        q, *rest = (memory.query_key_value.weight @ x).split(3)
        gates = torch.sigmoid(memory.gates(x))
        h = gates[n] * state["h"] if memory.gate_alpha else state["h"]
        for j in range(n):
            k = F.silu(rest[j])
            k = k / (k.norm() + 1e-6)
            beta = memory.beta_range * gates[j]
            householder = torch.eye(3, dtype=F64) - beta * torch.outer(k, k)
            h = householder @ h + beta * torch.outer(k, rest[n + j])
        q = F.silu(q)
        return memory.output(h.T @ (q / (q.norm() + 1e-6))), {"h": h}

    assert_is_written_out(memory, x, state, is_init, step)


def test_with_one_write_a_step_it_is_the_gated_delta_net() -> None:
    ours = make_memory("deltaproduct", 4, 9, householders=1)
    theirs = make_memory("gdn", 4, 9)
    theirs.load_state_dict(ours.state_dict())
    x = torch.randn(2, 40, 4)
    is_init = torch.rand(2, 40) < 0.1
    y, _ = ours(x, ours.initial_state(2), is_init)
    wanted, _ = theirs(x, theirs.initial_state(2), is_init)
    torch.testing.assert_close(y, wanted, rtol=0, atol=0)


def test_two_writes_a_step_can_turn_by_a_quarter_and_one_cannot() -> None:
    """Two reflections, along (1, 0) and along the diagonal, are a rotation."""
    diagonal = 0.5**0.5
    key = torch.tensor([[[1.0, 0.0], [diagonal, diagonal]]], dtype=F64)
    nothing = torch.zeros(1, 2, 2, dtype=F64)
    two = torch.full((1, 2, 1), 2.0, dtype=F64)
    memory = make_memory("deltaproduct", 2, 4, gate_alpha=False).to(F64)
    begin = torch.eye(2, dtype=F64)[None]
    steps = MatrixSteps(nothing, key, nothing, two)
    _, after = memory.scan(steps, torch.zeros(1, 1, dtype=torch.bool), begin)
    turned = torch.tensor([[[0.0, -1.0], [1.0, 0.0]]], dtype=F64)
    torch.testing.assert_close(after, turned, rtol=0, atol=1e-12)
    assert torch.linalg.det(after) > 0  # a reflection has -1


def test_its_scan_is_that_of_flash_linear_attention() -> None:
    """Its naive form (fla-core 0.6.0), in float32, a head for each row of the batch."""
    naive = file_of("fla", "ops/gated_delta_product/naive.py")
    memory, x, state, _ = problem("deltaproduct", householders=3, key_size=4)
    memory = memory.float()
    x = x.float()
    steps = memory.steps(x, {})
    is_init = torch.zeros(x.shape[:2], dtype=torch.bool)
    o, last = memory.scan(steps, is_init, state["h"].float())
    assert steps.erase is not None and steps.log_decay is not None
    wanted, wanted_last = naive.naive_recurrent_gated_delta_product(
        steps.query[:, ::3, None],
        steps.key[:, :, None],
        (steps.value / steps.erase)[:, :, None],
        steps.log_decay[:, ::3],
        steps.erase,
        1.0,
        initial_state=state["h"].float()[:, None],
        output_final_state=True,
        num_householder=3,
    )
    torch.testing.assert_close(o, wanted[:, :, 0], rtol=0, atol=1e-5)
    torch.testing.assert_close(last, wanted_last[:, 0], rtol=0, atol=1e-5)


def test_no_writes_are_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^householders must be positive, got 0$"):
        make_memory("deltaproduct", 3, 4, householders=0)


def test_one_forward_pass_is_pinned() -> None:
    y = pinned_pass("deltaproduct", key_size=2)
    torch.testing.assert_close(y, torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-7)


PINNED = [[-0.35554103, -0.24659659], [-1.35706288, -1.24660691], [-1.16904424, 0.18219165]]
"""Of NumPy, one step at a time."""
