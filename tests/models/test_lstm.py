"""The LSTM is torch's, with starts in the middle of a sequence; its numbers are pinned."""

import pytest
import torch
from torch import nn

from arcade_torch.models import make_memory
from arcade_torch.models.lstm import lstm_loop, lstm_scan, lstm_scan_backward

F64 = torch.float64


def pair() -> tuple[nn.Module, nn.LSTM]:
    """Ours and torch's with the same weights."""
    theirs = nn.LSTM(3, 5, batch_first=True, dtype=F64)
    ours = make_memory("lstm", 3, 5).to(F64)
    with torch.no_grad():
        ours.from_input.weight.copy_(theirs.weight_ih_l0)
        ours.from_input.bias.copy_(theirs.bias_ih_l0 + theirs.bias_hh_l0)
        ours.from_state.weight.copy_(theirs.weight_hh_l0)
    return ours, theirs


def test_values_states_and_gradients_are_those_of_torch() -> None:
    ours, theirs = pair()
    x = torch.randn(2, 9, 3, dtype=F64)
    h, c = torch.randn(2, 2, 5, dtype=F64)
    state = ours.initial_state(2).set("h", torch.stack([h, c], dim=1))
    y, after = ours(x, state, torch.zeros(2, 9, dtype=torch.bool))
    wanted, (last_h, last_c) = theirs(x, (h[None], c[None]))
    torch.testing.assert_close(y, wanted, rtol=0, atol=1e-14)
    torch.testing.assert_close(after["h"][:, 0], last_h[0], rtol=0, atol=1e-14)
    torch.testing.assert_close(after["h"][:, 1], last_c[0], rtol=0, atol=1e-14)

    direction = torch.randn_like(y)
    (y * direction).sum().backward()
    (wanted * direction).sum().backward()
    for mine, torchs in (
        (ours.from_input.weight, theirs.weight_ih_l0),
        (ours.from_input.bias, theirs.bias_ih_l0),
        (ours.from_state.weight, theirs.weight_hh_l0),
    ):
        torch.testing.assert_close(mine.grad, torchs.grad, rtol=1e-12, atol=1e-13)


def test_a_start_in_the_middle_is_torchs_lstm_begun_again() -> None:
    ours, theirs = pair()
    x = torch.randn(2, 9, 3, dtype=F64)
    is_init = torch.zeros(2, 9, dtype=torch.bool)
    is_init[:, 4] = True
    y, _ = ours(x, ours.initial_state(2), is_init)
    wanted = torch.cat([theirs(x[:, :4])[0], theirs(x[:, 4:])[0]], dim=1)
    torch.testing.assert_close(y, wanted, rtol=0, atol=1e-14)


def few_starts(memory: nn.Module) -> list[torch.Tensor]:
    """x, a state and flags of 80 steps: one start at index 0, three in the middle at two steps."""
    dtype = memory.like.dtype
    x = torch.randn(3, 80, 4, dtype=dtype, requires_grad=True)
    h = torch.randn(3, 2, 6, dtype=dtype, requires_grad=True)
    is_init = torch.zeros(3, 80, dtype=torch.bool)
    is_init[0, 0] = is_init[1, 7] = is_init[2, 7] = is_init[1, 33] = True
    return [x, h, is_init]


def read(memory: nn.Module, x: torch.Tensor, h: torch.Tensor, is_init: torch.Tensor) -> list:
    """y, and the state after the last step."""
    state = memory.initial_state(len(x)).set("h", h)
    y, after = memory(x, state, is_init)
    return [y, after["h"]]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Steps that each call of torch's LSTM reads."""
    seen = []
    torchs = torch.lstm

    def counted(x: torch.Tensor, *rest: object) -> object:
        seen.append(x.shape[1])
        return torchs(x, *rest)

    monkeypatch.setattr(torch, "lstm", counted)
    return seen


@pytest.mark.skipif(not torch.backends.mkldnn.is_available(), reason="torch has no oneDNN here")
def test_few_starts_are_read_by_torchs_own_operator_values_and_gradients(calls: list[int]) -> None:
    memory = make_memory("lstm", 4, 6)
    x, h, is_init = few_starts(memory)
    ours = read(memory, x, h, is_init)
    assert calls == [7, 26, 47]
    y, states = memory.run(x, h, is_init)
    assert calls == [7, 26, 47]
    plain = [y, states[:, -1]]
    torch.testing.assert_close(ours, plain, rtol=1e-6, atol=1e-6)
    leaves = [x, h, *memory.parameters()]
    directions = [torch.randn_like(out) for out in plain]
    gradients = torch.autograd.grad(ours, leaves, directions)
    wanted = torch.autograd.grad(plain, leaves, directions)
    for got, expected in zip(gradients, wanted, strict=True):
        scale = float(expected.abs().max())
        torch.testing.assert_close(got, expected, rtol=0, atol=2e-6 * scale)
    assert not gradients[1][0].any()  # what the flag at index 0 forgets


def test_a_start_hides_what_was_before_from_torchs_operator_too() -> None:
    memory = make_memory("lstm", 4, 6)
    x, h, is_init = few_starts(memory)
    with torch.no_grad():
        y, after = read(memory, x, h, is_init)
        h[0] = torch.nan
        x[2, 6] = torch.nan
        poisoned, after_poisoned = read(memory, x, h, is_init)
    assert torch.equal(poisoned[2, 7:], y[2, 7:])
    assert torch.equal(poisoned[0], y[0])
    assert torch.equal(after_poisoned, after)
    assert poisoned[2, 6].isnan().all()


def test_many_starts_few_rows_and_float64_are_read_by_the_loop(calls: list[int]) -> None:
    memory = make_memory("lstm", 4, 6)
    x, h, is_init = few_starts(memory)
    read(memory, x[:1, :60], h[:1], is_init[:1, :60])  # rows
    is_init[0, 10] = True
    read(memory, x, h, is_init)
    tenfold = [rows.repeat_interleave(10, 0) for rows in (x[:, :15], h, is_init[:, :15])]
    read(memory, *tenfold)  # steps
    read(memory.double(), *few_starts(memory))
    assert calls == []


def test_vmap_is_given_the_loop(calls: list[int]) -> None:
    memory = make_memory("lstm", 4, 6)
    x, h, is_init = few_starts(memory)
    with torch.no_grad():
        wanted = read(memory, x, h, is_init)
    calls.clear()
    weights = dict(memory.named_parameters())

    def outputs(weights: dict, h: torch.Tensor) -> list:
        state = memory.initial_state(3).set("h", h)
        y, after = torch.func.functional_call(memory, weights, (x, state, is_init))
        return [y, after["h"]]

    two = {name: torch.stack([weight, weight]) for name, weight in weights.items()}
    got = torch.func.vmap(outputs, in_dims=(0, None))(two, h)
    assert calls == []
    torch.testing.assert_close([each[1] for each in got], wanted, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(outputs(weights, h), wanted, rtol=0, atol=0)


def problem(every: bool = True) -> list[torch.Tensor]:
    """Random arguments of the scan, with a start at index 0, and a state to load for every step or
    for index 0 alone.
    """
    x = torch.randn(2, 6, 4, dtype=F64, requires_grad=True)
    input_weight = torch.randn(12, 4, dtype=F64, requires_grad=True)
    input_bias = torch.randn(12, dtype=F64, requires_grad=True)
    weight = torch.randn(12, 3, dtype=F64, requires_grad=True)
    stored = torch.randn(2, 6 if every else 1, 2, 3, dtype=F64, requires_grad=True)
    start = torch.rand(2, 6) < 0.4
    start[:, 0] = True
    return [x, input_weight, input_bias, weight, start, stored]


@pytest.mark.parametrize("seed", range(5))
def test_the_operator_equals_the_loop_values_and_gradients(seed: int) -> None:
    torch.manual_seed(seed)
    arguments = problem(every=seed % 2 == 0)
    ours = lstm_scan(*arguments)[0]
    plain = lstm_loop(*arguments)[0]
    torch.testing.assert_close(ours, plain, rtol=0, atol=1e-14)
    leaves = [x for x in arguments if x.requires_grad]
    direction = torch.randn_like(plain)  # at h and at c
    gradients = torch.autograd.grad(ours, leaves, direction)
    wanted = torch.autograd.grad(plain, leaves, direction)
    torch.testing.assert_close(gradients, wanted, rtol=1e-9, atol=1e-12)


def test_opcheck_passes() -> None:
    arguments = problem()
    torch.library.opcheck(lstm_scan, arguments)
    with torch.no_grad():
        states, gates = lstm_scan(*arguments)
    detached = [x.detach() for x in arguments[3:]]
    torch.library.opcheck(lstm_scan_backward, (*detached, states, gates, torch.randn_like(states)))


def test_initial_weights_are_drawn_as_torch_draws_them() -> None:
    weights = torch.cat([p.flatten() for p in make_memory("lstm", 64, 256).parameters()])
    assert weights.abs().max() <= 1 / 16
    assert float(weights.detach().std()) == pytest.approx(1 / 16 / 3**0.5, rel=0.02)


@torch.no_grad()
def test_one_forward_pass_is_pinned() -> None:
    memory = make_memory("lstm", 2, 2).double()
    for number, parameter in enumerate(memory.parameters(), 1):
        places = torch.arange(parameter.numel(), dtype=F64)
        parameter.copy_(torch.sin(number + places).view_as(parameter))
    x = torch.cos(torch.arange(6, dtype=F64)).view(1, 3, 2)
    y, state = memory(x, memory.initial_state(1), torch.zeros(1, 3, dtype=torch.bool))
    torch.testing.assert_close(y[0], torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-6)
    assert torch.equal(state["h"][0, 0], y[0, -1])


PINNED = [[-0.12554549, -0.18269191], [0.03346850, 0.36448462], [-0.26381443, 0.19179912]]
"""Of torch.nn.LSTM 2.13."""
