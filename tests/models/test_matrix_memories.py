"""Linear transformer, gated delta net and TTT-linear are the published equations; options do what
they say.
"""

import pytest
import torch
from torch.nn import functional as F

from arcade_torch.models import MemoryLawError, check_memory, make_memory

F64 = torch.float64
STEPS = 9


def run(name, **options):
    """A model in float64, its inputs with a start at index 5, and its outputs from the initial
    state.
    """
    memory = make_memory(name, 3, 9, **options).double()
    x, is_init = torch.randn(1, STEPS, 3, dtype=F64), torch.zeros(1, STEPS, dtype=torch.bool)
    is_init[:, 5] = True
    y, state = memory(x, memory.initial_state(1), is_init)
    return memory, x[0], y[0], state[0]


def projected(memory, x):
    return [rows.unbind(0) for rows in memory.query_key_value(x).chunk(3, -1)]


@pytest.mark.parametrize("legacy", [False, True])
def test_the_linear_transformer_divides_by_the_running_sum_of_keys_or_as_published_by_the_last(
    legacy,
):
    memory, x, y, state = run("linear_transformer", legacy_normaliser=legacy)
    queries, keys, values = projected(memory, x)
    for t in range(STEPS):
        if t in (0, 5):
            s, n = torch.zeros(3, 3, dtype=F64), torch.zeros(3, dtype=F64)
        q, k, v = F.elu(queries[t]) + 1, F.elu(keys[t]) + 1, values[t]
        s, n = s + torch.outer(k, v), k if legacy else n + k
        torch.testing.assert_close(y[t], memory.output(q @ s / (1e-6 + q @ n)) + memory.skip(x[t]))
    torch.testing.assert_close(state["h"], s if legacy else torch.cat([s, n[:, None]], 1))


def test_the_published_normaliser_is_lawful_but_for_the_law_of_averages():
    with pytest.raises(MemoryLawError, match="sum to one") as caught:
        check_memory(make_memory("linear_transformer", 4, 4, legacy_normaliser=True))
    assert caught.value.law == "an average of equal values is that value"
    memory = make_memory("linear_transformer", 4, 4, legacy_normaliser=True)
    memory.averages_values = False
    check_memory(memory)


def test_the_input_passes_a_linear_transformer_unchanged_if_the_sizes_allow_it():
    assert make_memory("linear_transformer", 8, 8).skip(torch.ones(8)).equal(torch.ones(8))
    assert make_memory("linear_transformer", 3, 8).skip(torch.ones(3)).shape == (8,)


@pytest.mark.parametrize("gate_alpha", [True, False])
@pytest.mark.parametrize("beta_range", [1.0, 2.0])
@pytest.mark.parametrize("legacy_left", [False, True])
def test_the_gated_delta_net_is_the_equation_with_every_option(gate_alpha, beta_range, legacy_left):
    options = {"gate_alpha": gate_alpha, "beta_range": beta_range, "legacy_left": legacy_left}
    memory, x, y, state = run("gdn", **options)
    queries, keys, values = projected(memory, x)
    for t in range(STEPS):
        if t in (0, 5):
            h = torch.zeros(3, 3, dtype=F64)
        q, k = (F.silu(u) / (F.silu(u).norm() + 1e-6) for u in (queries[t], keys[t]))
        gates = torch.sigmoid(memory.gates(x[t]))
        beta, alpha = beta_range * gates[0], gates[1] if gate_alpha else 1.0
        transition = alpha * (torch.eye(3, dtype=F64) - beta * torch.outer(k, k))
        h = (transition @ h if legacy_left else h @ transition) + beta * torch.outer(values[t], k)
        torch.testing.assert_close(y[t], memory.output(h @ q))
    torch.testing.assert_close(state["h"], h.T)


def test_the_gated_delta_net_replaces_what_it_stored_under_a_key_and_the_published_one_does_not():
    x = torch.randn(1, 2, 3, dtype=F64)
    recalled = {}
    for legacy in (False, True):
        torch.manual_seed(5)
        memory = make_memory(
            "gdn", 3, 9, gate_alpha=False, beta_range=2.0, legacy_left=legacy
        ).double()
        with torch.no_grad():
            for layer in (memory.gates, memory.query_key_value):
                layer.weight[:1].zero_()
            memory.gates.weight.zero_()
            memory.gates.bias.zero_()  # beta = 1: a full write
            memory.query_key_value.weight[:6] = 0.0
            memory.query_key_value.weight[:6, 0] = torch.tensor(
                [1.0, 2.0, 3.0] * 2
            )  # equal queries and keys
            x[..., 0] = 1.0
        y, _ = memory(x, memory.initial_state(1), torch.zeros(1, 2, dtype=torch.bool))
        written = memory.output(memory.query_key_value(x).chunk(3, -1)[2])
        recalled[legacy] = (y - written)[0, 1].abs().max()
    assert recalled[False] < 1e-5 < 1e-2 < recalled[True]


def test_the_decay_gate_begins_almost_open():
    assert make_memory("gdn", 4, 4).gates.bias[1] == 4.0


@pytest.mark.parametrize("beta_range", [0, -1.0, 2.1, float("nan")])
def test_a_write_strength_that_explodes_is_refused(beta_range):
    with pytest.raises(ValueError, match=r"beta_range must lie in \(0, 2\]"):
        make_memory("gdn", 4, 4, beta_range=beta_range)


def test_ttt_is_one_gradient_step_a_time_step_from_a_learned_start():
    memory, x, y, state = run("ttt")
    queries, keys, values = projected(memory, x)
    speed = 10_000.0 ** (-torch.arange(1, dtype=F64))

    def turned(u, position):
        pair = torch.complex(u[:1], u[1:2]) * torch.polar(torch.ones_like(speed), position * speed)
        u = torch.cat([torch.view_as_real(pair).flatten(), u[2:]])
        return u / (u.norm() + 1e-6)

    for t in range(STEPS):
        if t in (0, 5):
            w = memory.start.detach().T
        position = t if t < 5 else t - 5
        q, k = turned(queries[t], position), turned(keys[t], position)
        w = w.detach().requires_grad_()
        loss = 0.5 * (w @ k - values[t]).square().sum()
        w = w - torch.sigmoid(memory.rate(x[t])) * torch.autograd.grad(loss, w)[0]
        torch.testing.assert_close(y[t], memory.output(w @ q))
    torch.testing.assert_close(state["h"].T + memory.start.T, w)
    assert state["step"] == 4


def test_the_start_of_ttt_is_learned_and_an_episode_begins_there_not_at_the_carried_state():
    memory = make_memory("ttt", 3, 9)
    assert 0.005 < memory.start.std() < 0.05
    x, flags = torch.randn(2, 4, 3), torch.zeros(2, 4, dtype=torch.bool)
    y, state = memory(x, memory.initial_state(2), flags)
    (gradient,) = torch.autograd.grad(y.sum(), memory.start)
    assert (gradient != 0).all() and state["step"].tolist() == [4, 4]
    flags[:, 0] = True
    again, _ = memory(x, state, flags)
    assert torch.equal(again, y)


def test_key_size_is_the_root_of_the_width_or_what_one_asks_for():
    for name in ("linear_transformer", "gdn", "ttt"):
        assert make_memory(name, 512, 512).key_size == 23
        assert make_memory(name, 4, 4, key_size=7).initial_state(2)["h"].shape[:2] == (2, 7)
        check_memory(make_memory(name, 3, 4, key_size=3), gradients=False)
        with pytest.raises(ValueError, match="key_size must be positive, got 0"):
            make_memory(name, 4, 4, key_size=0)
