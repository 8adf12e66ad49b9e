"""sLSTM and mLSTM are the paper's equations without a stabiliser and the authors' code with one;
their numbers are pinned.
"""

import math

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models import make_memory
from arcade_torch.models.mlstm import decayed_max
from arcade_torch.models.slstm import slstm_loop, slstm_scan, slstm_scan_backward
from tests.models.zoo import F64, assert_each_episode, pinned_pass, starts


def slstm_oracle(memory: nn.Module, x: Tensor) -> Tensor:
    """Equations 8 to 14 as they stand, from zeros."""
    h = c = n = torch.zeros(memory.hidden_size, dtype=x.dtype)
    outputs = []
    for x_t in x:
        a, b, d, e = (memory.from_input(x_t) + memory.from_state(h)).chunk(4)
        f = torch.sigmoid(b)
        c = f * c + a.exp() * d.tanh()
        n = f * n + a.exp()
        h = e.sigmoid() * c / n
        outputs.append(h)
    return torch.stack(outputs)


def mlstm_oracle(memory: nn.Module, x: Tensor) -> Tensor:
    """Equations 19 to 27 as they stand, from zeros."""
    size = memory.key_size
    matrix = torch.zeros(size, size, dtype=x.dtype)
    n = torch.zeros(size, dtype=x.dtype)
    outputs = []
    for x_t in x:
        q, k, v = memory.query_key_value(x_t).chunk(3)
        k = k / math.sqrt(size)
        log_i, forget = memory.gates(x_t)
        matrix = forget.sigmoid() * matrix + log_i.exp() * torch.outer(v, k)
        n = forget.sigmoid() * n + log_i.exp() * k
        answer = matrix @ q / (n @ q).abs().clamp_min(1)
        outputs.append(memory.output(memory.output_gate(x_t).sigmoid() * answer))
    return torch.stack(outputs)


ORACLES = {"slstm": slstm_oracle, "mlstm": mlstm_oracle}


@pytest.mark.parametrize("name", ORACLES)
@pytest.mark.parametrize("sizes", [(4, 4), (3, 9)])
def test_it_is_the_papers_equation(name: str, sizes: tuple[int, int]) -> None:
    memory = make_memory(name, *sizes).double()
    assert_each_episode(memory, lambda x: ORACLES[name](memory, x))


def test_slstm_is_that_of_the_authors() -> None:
    """xlstm 2.0.6, one step of it after the other; its starts are those of whole batches."""
    theirs = pytest.importorskip(
        "xlstm.blocks.slstm.src.vanilla.slstm", reason="needs pip install xlstm"
    )
    memory = make_memory("slstm", 3, 5).double()

    def oracle(x: Tensor) -> Tensor:
        states = torch.zeros(4, 1, 5, dtype=F64)
        outputs = []
        for x_t in x:
            from_input = F.linear(x_t, memory.from_input.weight).unsqueeze(0)
            from_state = memory.from_state(states[0])
            bias = memory.from_input.bias.unsqueeze(0)
            states, _ = theirs.slstm_forward_pointwise(from_input, from_state, bias, states, {})
            outputs.append(states[0, 0])
        return torch.stack(outputs)

    assert_each_episode(memory, oracle)


def test_mlstm_is_that_of_the_authors() -> None:
    """xlstm 2.0.6, the parallel form, without the 1e-6 that it adds to the denominator."""
    theirs = pytest.importorskip("xlstm.blocks.mlstm.backends", reason="needs pip install xlstm")
    memory = make_memory("mlstm", 3, 9).double()

    def oracle(x: Tensor) -> Tensor:
        q, k, v = memory.query_key_value(x)[None, None].chunk(3, dim=-1)
        i, f = memory.gates(x)[None, None].split(1, dim=-1)
        answer = theirs.parallel_stabilized_simple(q, k, v, i, f, eps=0.0)[0, 0]
        y: Tensor = memory.output(memory.output_gate(x).sigmoid() * answer)
        return y

    assert_each_episode(memory, oracle)


@pytest.mark.parametrize("name", ORACLES)
@pytest.mark.parametrize("log_i", [-200.0, 0.0, 90.0, 300.0])
def test_gates_whose_exponential_single_precision_does_not_hold(name: str, log_i: float) -> None:
    """exp(90) is infinite in float32; float64 goes to exp(709), so the oracle needs no
    stabiliser.
    """
    torch.manual_seed(2)
    memory = make_memory(name, 4, 16)
    with torch.no_grad():
        bias = memory.gates.bias[:1] if name == "mlstm" else memory.from_input.bias[:16]
        bias.fill_(log_i)
    x = torch.randn(1, 60, 4)
    y, state = memory(x, memory.initial_state(1), torch.zeros(1, 60, dtype=torch.bool))
    gradients = torch.autograd.grad(y.square().sum(), list(memory.parameters()))
    exact = memory.double()
    wanted = ORACLES[name](exact, x[0].double())
    wanted_gradients = torch.autograd.grad(wanted.square().sum(), list(exact.parameters()))
    torch.testing.assert_close(y[0].double(), wanted, rtol=1e-3, atol=1e-4)
    assert all(leaf.isfinite().all() for leaf in state.values())
    for mine, right in zip(gradients, wanted_gradients, strict=True):
        assert (mine.double() - right).norm() <= 1e-3 * right.norm() + 1e-6


def test_the_state_is_that_of_the_equations_times_exp_of_minus_m() -> None:
    memory = make_memory("mlstm", 3, 4).double()
    x = 3 * torch.randn(1, 8, 3, dtype=F64)
    _, state = memory(x, memory.initial_state(1), torch.zeros(1, 8, dtype=torch.bool))
    m = torch.zeros((), dtype=F64)
    n = torch.zeros(2, dtype=F64)
    for x_t in x[0]:
        log_i, forget = memory.gates(x_t)
        key = memory.query_key_value(x_t)[2:4] / math.sqrt(2)
        n = forget.sigmoid() * n + log_i.exp() * key
        m = torch.maximum(F.logsigmoid(forget) + m, log_i).clamp_min(0)
    torch.testing.assert_close(state["m"][0], m.detach())
    torch.testing.assert_close(state["h"][0, :, -1], (n * torch.exp(-m)).detach())
    assert m > 0


@pytest.mark.parametrize("length", [1, 2, 5, 33])
def test_the_maximum_that_decays_equals_its_loop(length: int) -> None:
    decay = -torch.rand(3, length, dtype=F64)
    given = 3 * torch.randn(3, length, dtype=F64)
    start = torch.rand(3, length) < 0.2
    start[:, 0] = True
    m = decayed_max(decay, given, start)
    for t in range(length):
        carried = given[:, t] if t == 0 else torch.maximum(decay[:, t] + m[:, t - 1], given[:, t])
        wanted = torch.where(start[:, t], given[:, t], carried)
        torch.testing.assert_close(m[:, t], wanted)


def test_an_environment_that_begins_alone_begins_as_all_do() -> None:
    """Where code asks whether all n of a batch are 0, a weak first input is lost in m = 0."""
    memory = make_memory("slstm", 3, 4)
    with torch.no_grad():
        memory.from_input.bias[:4] = -150.0
    x = torch.randn(2, 4, 3)
    y, _ = memory(x, memory.initial_state(2), starts((2,), (), length=4))
    alone, _ = memory(x[:1, 2:], memory.initial_state(1), starts((), length=2))
    assert y.isfinite().all()
    # a product of two rows may round otherwise than that of one
    torch.testing.assert_close(y[:1, 2:], alone)


def problem() -> list[Tensor]:
    """Random arguments of the sLSTM's scan, with starts at zeros and at states."""
    steps = torch.randn(2, 6, 12, dtype=F64, requires_grad=True)
    weight = torch.randn(12, 3, dtype=F64, requires_grad=True)
    stored = torch.randn(2, 6, 4, 3, dtype=F64)
    stored[:, :, 2] = stored[:, :, 2].abs() + 1
    stored[0] = 0
    start = torch.rand(2, 6) < 0.4
    start[:, 0] = True
    return [steps, weight, start, stored.requires_grad_()]


@pytest.mark.parametrize("seed", range(3))
def test_the_operator_equals_the_loop_values_and_gradients(seed: int) -> None:
    torch.manual_seed(seed)
    arguments = problem()
    ours = slstm_scan(*arguments)[0]
    plain = slstm_loop(*arguments)[0]
    torch.testing.assert_close(ours, plain, rtol=0, atol=0)
    leaves = [x for x in arguments if x.requires_grad]
    direction = torch.randn_like(plain)
    direction[:, :, 3] = 0  # m is a constant to gradients
    gradients = torch.autograd.grad(ours, leaves, direction)
    wanted = torch.autograd.grad(plain, leaves, direction)
    for mine, right in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(mine, right, rtol=1e-9, atol=1e-12)


def test_opcheck_passes() -> None:
    arguments = problem()
    # what compiling needs beside these is tested with every model
    utils = ("test_schema", "test_faketensor", "test_autograd_registration")
    torch.library.opcheck(slstm_scan, arguments, test_utils=utils)
    with torch.no_grad():
        states, gates = slstm_scan(*arguments)
    detached = [x.detach() for x in arguments[1:]]
    rest = (states, gates, torch.randn_like(states))
    torch.library.opcheck(slstm_scan_backward, (*detached, *rest), test_utils=utils)


@pytest.mark.parametrize(
    ("name", "pinned"),
    [
        (
            "slstm",
            [[-0.13984860, -0.39895915], [-0.01635478, 0.54281214], [-0.18808043, 0.32813502]],
        ),
        ("mlstm", [[1.01430050, 0.44967911], [0.99293170, 0.41749975], [0.98966688, 0.41258326]]),
    ],
)
def test_one_forward_pass_is_pinned(name: str, pinned: list[list[float]]) -> None:
    y = pinned_pass(make_memory(name, 2, 2))
    torch.testing.assert_close(y, torch.tensor(pinned, dtype=F64), rtol=0, atol=1e-6)
