"""Every registered memory model keeps the laws; sizes are the published ones."""

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from arcade_torch.models import linear_scan, make_memory, memory_names, register_memory
from arcade_torch.models.base import Memory, MemoryContract, ReplayableMemory
from arcade_torch.models.laws import check_memory

MODELS = [
    ("lru", {}),
    ("lru", {"r_min": 0.9, "r_max": 0.999, "max_phase": 0.3}),
    ("mingru", {}),
    ("mingru", {"candidate": "linear", "slow_gates": True}),
    ("gru", {}),
    ("mlp", {}),
]


@pytest.mark.parametrize(("name", "options"), MODELS)
@pytest.mark.parametrize("sizes", [(4, 4), (3, 5)])
def test_every_model_keeps_the_laws(name, options, sizes):
    check_memory(make_memory(name, *sizes, **options))


@pytest.mark.parametrize("name", memory_names())
def test_every_model_satisfies_the_protocols(name):
    memory = make_memory(name, 3, 4)
    assert isinstance(memory, MemoryContract) and isinstance(memory, ReplayableMemory)


@pytest.mark.parametrize(
    ("name", "count"), [("lru", 1_050_624), ("gru", 1_574_400), ("mingru", 525_312), ("mlp", 262_656)]
)
def test_parameter_counts_at_width_512_are_the_published_ones(name, count):
    assert sum(p.numel() for p in make_memory(name, 512, 512).parameters()) == count


@pytest.mark.parametrize("name", memory_names())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_parameters(name, dtype):
    memory = make_memory(name, 3, 4).to(dtype)
    state = memory.initial_state(2)
    y, after = memory(torch.randn(2, 5, 3, dtype=dtype), state, torch.zeros(2, 5, dtype=torch.bool))
    assert y.dtype == dtype
    assert all(v.dtype == dtype for td in (state, after) for v in td.values())


def test_states_are_zeros_and_complex_ones_are_real_pairs():
    assert make_memory("lru", 3, 4).initial_state(2)["h"].shape == (2, 4, 2)
    assert make_memory("gru", 3, 4).initial_state((2, 7))["h"].shape == (2, 7, 4)
    assert make_memory("mlp", 3, 4).initial_state(2).is_empty()
    assert all((make_memory(name, 3, 4).initial_state(2) == 0).all() for name in ("lru", "gru", "mingru"))


def test_mingru_is_the_papers_equation():
    memory = make_memory("mingru", 3, 4)
    x, h = torch.randn(2, 6, 3), torch.randn(2, 4)
    (w1, w2), (b1, b2) = memory.gate_and_candidate.weight.chunk(2), memory.gate_and_candidate.bias.chunk(2)
    state = memory.initial_state(2).set("h", h)
    y, _ = memory(x, state, torch.zeros(2, 6, dtype=torch.bool))
    for t in range(6):
        g = torch.sigmoid(x[:, t] @ w1.T + b1)
        h = (1 - g) * h + g * torch.tanh(x[:, t] @ w2.T + b2)
        torch.testing.assert_close(y[:, t], h)


def test_slow_gates_spread_the_gate_bias_and_leave_the_candidate_alone():
    bias = make_memory("mingru", 64, 512, slow_gates=True).gate_and_candidate.bias
    assert -5 <= bias[:512].min() < -4.8 and -0.2 < bias[:512].max() <= 0
    assert bias[512:].abs().max() <= 1 / 8


def test_gru_is_the_papers_and_not_torchs():
    memory = make_memory("gru", 3, 4)
    x, h = torch.randn(2, 6, 3), torch.randn(2, 4)
    wz, wr, wh = memory.from_input.weight.chunk(3)
    bz, br, bh = memory.from_input.bias.chunk(3)
    uz, ur = memory.gates_from_state.weight.chunk(2)
    uh = memory.candidate_from_state.weight
    y, _ = memory(x, memory.initial_state(2).set("h", h), torch.zeros(2, 6, dtype=torch.bool))
    for t in range(6):
        z = torch.sigmoid(F.linear(x[:, t], wz, bz) + h @ uz.T)
        r = torch.sigmoid(F.linear(x[:, t], wr, br) + h @ ur.T)
        c = torch.tanh(F.linear(x[:, t], wh, bh) + (r * h) @ uh.T)
        h = (1 - z) * h + z * c
        torch.testing.assert_close(y[:, t], h)


def test_lru_is_the_papers_equation_in_complex_numbers():
    memory = make_memory("lru", 4, 4).double()
    x = torch.randn(2, 6, 4, dtype=torch.float64)
    decay = torch.exp(torch.complex(-memory.nu.exp(), memory.theta.exp()))
    b, c = torch.complex(memory.input[:, 0], memory.input[:, 1]), torch.view_as_complex(memory.output.data).conj()
    y, state = memory(x, memory.initial_state(2), torch.zeros(2, 6, dtype=torch.bool))
    h = torch.zeros(2, 4, dtype=torch.complex128)
    for t in range(6):
        h = decay * h + memory.gamma.exp() * (x[:, t].to(h.dtype) @ b.T)
        torch.testing.assert_close(y[:, t], (h @ c.T).real + memory.skip * x[:, t])
    torch.testing.assert_close(torch.view_as_complex(state["h"]), h)


def test_lru_starts_inside_the_ring_and_normalised():
    memory = make_memory("lru", 8, 1000, r_min=0.5, r_max=0.9)
    radius = torch.exp(-memory.nu.exp())
    assert 0.5 <= radius.min() < 0.52 and 0.88 < radius.max() <= 0.9
    torch.testing.assert_close(memory.gamma.exp(), torch.sqrt(1 - radius**2))
    assert all(torch.isfinite(p).all() for p in make_memory("lru", 8, 1000).parameters())


def test_an_unknown_name_is_answered_with_the_nearest_and_the_list():
    with pytest.raises(ValueError, match=r"'minigru'.*mean 'mingru'.*lru, mingru, gru, mlp"):
        make_memory("minigru", 3, 4)


def test_names_are_registered_once_and_must_be_identifiers():
    def factory(input_size, hidden_size, width=1):
        return make_memory("gru", input_size, hidden_size * width)

    register_memory("tests_wide_gru", factory)
    assert "tests_wide_gru" in memory_names()
    assert make_memory("tests_wide_gru", 3, 4, width=2).hidden_size == 8
    with pytest.raises(ValueError, match="already"):
        register_memory("tests_wide_gru", factory)
    register_memory("tests_wide_gru", factory, overwrite=True)
    with pytest.raises(ValueError, match="identifier"):
        register_memory("Wide GRU", factory)
    with pytest.raises(TypeError, match="callable"):
        register_memory("tests_number", 3)


@pytest.mark.parametrize("name", memory_names())
def test_wrong_inputs_get_one_clear_line(name):
    memory = make_memory(name, 3, 4)
    flags = torch.zeros(2, 5, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"x must be \[B, T, 3\]"):
        memory(torch.zeros(2, 5, 7), memory.initial_state(2), flags)
    with pytest.raises(ValueError, match="squeeze"):
        memory(torch.zeros(2, 5, 3), memory.initial_state(2), flags.unsqueeze(-1))
    with pytest.raises(ValueError, match="positive"):
        make_memory(name, 0, 4)


def test_unknown_options_are_refused():
    with pytest.raises(ValueError, match="tanh"):
        make_memory("mingru", 3, 4, candidate="relu")
    with pytest.raises(ValueError, match="r_min"):
        make_memory("lru", 3, 4, r_min=0.9, r_max=0.5)


def test_a_memory_of_ones_own_on_our_base_needs_only_run():
    class Sum(Memory):
        def __init__(self, input_size, hidden_size):
            super().__init__(input_size, hidden_size)
            self.state_shape = (input_size,)
            self.scale = nn.Parameter(torch.ones(()))

        def run(self, x, h0, is_init):
            h = linear_scan(torch.ones((), dtype=x.dtype), self.scale * x, is_init, h0)
            return h, h

    check_memory(Sum(3, 3))
