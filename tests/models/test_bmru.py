"""The bistable memory recurrent unit is a latch with hysteresis; its backward pass is the surrogate
that the page names; it remembers over delays that it has never seen.
"""

import math

import pytest
import torch
from torch import Tensor, nn

from arcade_torch.models import MemoryBlock, check_memory, make_memory
from arcade_torch.models.bmru import BMRU, surrogate_step
from arcade_torch.models.checks import MemoryLawError
from arcade_torch.models.scan import back_end, linear_scan
from arcade_torch.tools.bench.memory_tests import TESTS
from arcade_torch.tools.bench.memory_tests.training import Setting, train
from tests.models.scan_cases import linear_scan_loop
from tests.models.written_out import F64, assert_is_written_out, pinned_pass, problem


def latch(threshold: float = 0.5, size: int = 1) -> BMRU:
    """A cell that sets each latch by its own input, beyond one threshold."""
    memory = BMRU(size, size)
    with torch.no_grad():
        memory.candidate_and_threshold.weight.copy_(
            torch.cat([torch.eye(size), torch.zeros(size, size)])
        )
        memory.candidate_and_threshold.bias[:size] = 0
        memory.candidate_and_threshold.bias[size:] = -threshold  # beta is its absolute value
    return memory


def read(memory: nn.Module, x: Tensor, *starts: int) -> Tensor:
    """The outputs for inputs [T] or [T, D] of one episode, or of those that begin at ``starts``."""
    x = x.view(1, len(x), -1)
    flags = torch.zeros(x.shape[:2], dtype=torch.bool)
    flags[:, list(starts)] = True
    return memory(x, memory.initial_state(1), flags)[0][0]  # type: ignore[no-any-return]


def test_it_is_the_equations_one_step_after_the_other() -> None:
    memory, x, state, is_init = problem("bmru")
    w, v = memory.candidate_and_threshold.weight.chunk(2)
    b, d = memory.candidate_and_threshold.bias.chunk(2)

    def step(x: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        c = w @ x + b
        h = torch.where(c.abs() > (v @ x + d).abs(), c.sign(), state["h"])
        return h, {"h": h}

    assert_is_written_out(memory, x, state, is_init, step)


@pytest.mark.parametrize("form", ["serial", "doubling"])
def test_a_latch_holds_its_value_exactly_for_ten_thousand_steps(form: str) -> None:
    memory = latch(0.5, 2)
    x = 0.499 * (2 * torch.rand(10_001, 2) - 1)
    x[0] = torch.tensor([0.6, -0.6])
    x.requires_grad_()
    with back_end(form):
        y = read(memory, x)
        (gradient,) = torch.autograd.grad(y[-1, 0], x)
    assert torch.equal(y, torch.tensor([1.0, -1.0]).expand_as(y))
    assert gradient[0, 0] > 1e-3  # undiminished: the derivatives of step 0, at 0.1 and at 0.6
    expected = soft_step(0.1) + 2 * soft_step(0.6)
    assert float(gradient[0, 0]) == pytest.approx(expected, rel=1e-5)


def test_a_latch_is_set_beyond_the_threshold_keeps_below_it_and_flips_beyond_the_other() -> None:
    x = torch.tensor([0.2, 0.8, 0.4, -0.4, 0.5, -0.5, -0.8, 0.4, 0.5, 0.51, 0.0])
    expected = [0, 1, 1, 1, 1, 1, -1, -1, -1, 1, 1]
    assert read(latch(), x).flatten().tolist() == expected


def test_a_latch_is_neither_at_a_start_and_nothing_of_before_is_left() -> None:
    x = torch.tensor([0.8, 0.0, 0.0, 0.0, -0.8, 0.0])
    assert read(latch(), x, 2).flatten().tolist() == [1, 1, 0, 0, -1, -1]


def soft_step(u: float, slope: float = 8.0) -> float:
    """The derivative that the page states."""
    return slope / 2 / (1 + (math.pi / 2 * slope * u) ** 2)


@pytest.mark.parametrize("slope", [1.0, 8.0])
def test_the_step_is_exact_and_its_gradient_is_the_formula(slope: float) -> None:
    values = [-30.0, -1.0, -0.01, 0.0, 0.01, 0.3, 1e6]
    u = torch.tensor(values, dtype=F64, requires_grad=True)
    step = surrogate_step(u, slope)
    assert step.tolist() == [0, 0, 0, 0, 1, 1, 1]
    (gradient,) = torch.autograd.grad(step.sum(), u)
    expected = torch.tensor([soft_step(value, slope) for value in values], dtype=F64)
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("c", "d"), [(0.6, 0.5), (-0.6, 0.5), (0.4, -0.5), (-0.4, -0.5)])
def test_the_gradient_of_a_step_is_the_formula_written_out(c: float, d: float) -> None:
    memory = latch().double()
    before = torch.tensor([[-0.7]], dtype=F64, requires_grad=True)
    bias = memory.candidate_and_threshold.bias
    with torch.no_grad():
        bias.copy_(torch.tensor([c, d], dtype=F64))
    state = memory.initial_state(1).set("h", before)
    y, _ = memory(torch.zeros(1, 1, 1, dtype=F64), state, torch.zeros(1, 1, dtype=torch.bool))
    by_bias, by_state = torch.autograd.grad(y.sum(), [bias, before])
    sets = float(abs(c) > abs(d))
    sign = math.copysign(1, c)
    by_set = (sign + 0.7) * soft_step(abs(c) - abs(d))
    by_c = by_set * sign + sets * 2 * soft_step(c)
    by_d = -by_set * math.copysign(1, d)
    torch.testing.assert_close(by_bias, torch.tensor([by_c, by_d], dtype=F64), rtol=1e-10, atol=0)
    assert float(by_state) == 1 - sets


@pytest.mark.parametrize("form", ["serial", "doubling"])
def test_scans_take_decays_of_exactly_zero_and_one_and_give_their_gradients(form: str) -> None:
    a = (torch.rand(2, 33, 5) < 0.7).double().requires_grad_()
    b = torch.randn(2, 33, 5, dtype=F64, requires_grad=True)
    h0 = torch.randn(2, 5, dtype=F64, requires_grad=True)
    start = torch.rand(2, 33) < 0.1
    weight = torch.randn(2, 33, 5, dtype=F64)
    with back_end(form):
        h = linear_scan(a, b, start, h0)
        ours = torch.autograd.grad((weight * h).sum(), [a, b, h0])
    loop = linear_scan_loop(a, b, start, h0)
    theirs = torch.autograd.grad((weight * loop).sum(), [a, b, h0])
    torch.testing.assert_close(h, loop, rtol=0, atol=1e-12)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)


def test_it_recalls_over_sixteen_times_the_delay_that_it_learned() -> None:
    trained = train("bmru", TESTS["delay"], seed=5, setting=Setting(steps=150, answers=128))
    assert trained.accuracy[256][0] >= 0.99
    assert trained.accuracy[64][0] >= 0.99


class WithoutLongGradients(BMRU):
    """A loop whose gradient reaches one step back, though that of the given state is right."""

    replay = None  # type: ignore[assignment]

    def run(self, x: Tensor, h0: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Memory.run`."""
        states = []
        for t in range(x.shape[1]):
            _, h = super().run(x[:, t : t + 1], h0, is_init[:, t : t + 1])
            states.append(h[:, 0])
            h0 = h[:, 0].detach()
        h = torch.stack(states, dim=1)
        return h, h


def test_the_law_of_surrogates_refuses_a_gradient_that_ends_within_a_call() -> None:
    with pytest.raises(MemoryLawError, match="one call and of a call a step differ"):
        check_memory(WithoutLongGradients(3, 4))


def test_a_step_that_is_not_declared_breaks_the_law_of_finite_differences() -> None:
    memory = BMRU(3, 4)
    memory.surrogate_gradients = False
    with pytest.raises(MemoryLawError, match="finite differences disagree"):
        check_memory(memory)


def test_a_block_around_it_is_asked_for_the_gradients_of_its_steps() -> None:
    law = "gradients of one call are those of its steps"
    assert law in check_memory(MemoryBlock(3, 4, "bmru", layers=1))
    assert law not in check_memory(MemoryBlock(3, 4, "mingru", layers=1))


@pytest.mark.parametrize("slope", [0.0, -1.0, math.inf, math.nan])
def test_a_slope_out_of_range_is_refused_in_one_line(slope: float) -> None:
    with pytest.raises(ValueError, match=r"^slope must be a number above 0, got "):
        make_memory("bmru", 3, 4, slope=slope)


def test_one_forward_pass_is_pinned() -> None:
    assert pinned_pass("bmru").tolist() == PINNED


PINNED = [[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0]]
"""Of NumPy, one step at a time."""
