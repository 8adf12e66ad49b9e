"""Every registered memory model keeps the laws; sizes are the published ones."""

import itertools
import time

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from arcade_torch.models import linear_scan, make_memory, memory_names, register_memory, registry
from arcade_torch.models.checks import check_memory
from arcade_torch.models.memory import Memory, MemoryContract, ReplayableMemory
from tests.few import few_memories

MODELS = [
    ("lru", {}),
    ("lru", {"r_min": 0.9, "r_max": 0.999, "max_phase": 0.3}),
    ("mingru", {}),
    ("mingru", {"candidate": "linear", "slow_gates": True}),
    ("gru", {}),
    ("mlp", {}),
    ("linear_transformer", {}),
    ("attention", {}),
    ("attention", {"window": 3}),
    ("attention", {"window": 1}),
    ("gdn", {}),
    ("gdn", {"gate_alpha": False, "beta_range": 1.0}),
    ("gdn", {"legacy_left": True}),
    ("ttt", {}),
    ("lstm", {}),
    ("frame_stack", {}),
    ("frame_stack", {"frames": 2}),
    ("frame_stack", {"frames": 9}),
    ("ffm", {}),
    ("ffm", {"trace_size": 3, "context_size": 1}),
    ("shm", {}),
    ("shm", {"key_size": 3, "rows": 2}),
    ("rtu", {}),
    ("rtu", {"r_min": 0.9, "r_max": 0.999, "max_phase": 0.3}),
    ("deltaproduct", {}),
    ("deltaproduct", {"householders": 1}),
    ("deltaproduct", {"householders": 3, "gate_alpha": False, "beta_range": 1.0}),
    ("rwkv7", {}),
    ("rwkv7", {"key_size": 3}),
    ("s5", {}),
    ("mamba", {}),
    ("mamba", {"state_size": 3, "expand": 2, "conv": 2}),
    ("slstm", {}),
    ("mlstm", {}),
    ("mlstm", {"key_size": 3}),
    ("gtrxl", {}),
    ("gtrxl", {"window": 3}),
    ("bmru", {}),
    ("bmru", {"slope": 1.0}),
]
NAMES = memory_names()
LENGTHS = [1, 2, 3, 7, 128, 132, 1000]


@pytest.mark.parametrize(("name", "options"), MODELS)
def test_every_model_keeps_the_laws(name, options):
    check_memory(make_memory(name, 3, 5, **options))


@pytest.mark.parametrize("name", few_memories(NAMES))
def test_a_model_with_as_many_features_as_inputs_keeps_the_laws(name):
    check_memory(make_memory(name, 4, 4))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [model for model in MODELS if model[1]])
def test_a_model_of_every_option_with_as_many_features_as_inputs_keeps_the_laws(name, options):
    check_memory(make_memory(name, 4, 4, **options))


@pytest.mark.parametrize("name", NAMES)
def test_every_model_satisfies_the_protocols(name):
    memory = make_memory(name, 3, 4)
    assert isinstance(memory, MemoryContract) and isinstance(memory, ReplayableMemory)


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("lru", 1_050_624),
        ("gru", 1_574_400),
        ("mingru", 525_312),
        ("mlp", 262_656),
        ("attention", 786_944),
        ("linear_transformer", 47_616),
        ("gdn", 48_642),
        ("ttt", 48_658),  # our own variant, unpublished
        ("lstm", 2_099_200),  # torch.nn.LSTM without the second of its biases
        ("frame_stack", 1_049_088),
        ("ffm", 853_700),  # of which 525,312 are the output gate and the skip
        ("shm", 63_872),
        ("rtu", 1_050_112),
        ("deltaproduct", 72_707),
        ("rwkv7", 86_177),
        ("s5", 525_568),
        ("mamba", 835_072),
        ("slstm", 2_099_200),
        ("mlstm", 60_510),
        ("gtrxl", 4_461_056),
        ("bmru", 525_312),
    ],
)
def test_parameter_counts_at_width_512_are_the_published_ones(name, count):
    assert sum(p.numel() for p in make_memory(name, 512, 512).parameters()) == count


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_parameters(name, dtype):
    memory = make_memory(name, 3, 4).to(dtype)
    state = memory.initial_state(2)
    y, after = memory(torch.randn(2, 5, 3, dtype=dtype), state, torch.zeros(2, 5, dtype=torch.bool))
    assert y.dtype == dtype
    assert all(
        v.dtype == dtype for td in (state, after) for v in td.values() if v.is_floating_point()
    )


def problem(name, batch, steps, dtype, resets=0.03):
    """A model of width 6, inputs, a state that some steps have led to, and start flags."""
    memory = make_memory(name, 6, 6).to(dtype)
    x, flags = torch.randn(batch, steps + 5, 6, dtype=dtype), torch.rand(batch, steps) < resets
    with torch.no_grad():
        _, state = memory(
            x[:, steps:], memory.initial_state(batch), torch.zeros(batch, 5, dtype=torch.bool)
        )
    # a copy: a product of a view may round otherwise than that of its clone
    return memory, x[:, :steps].clone(), state, flags


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("steps", [1, 3, 80])
@torch.no_grad()
def test_what_is_written_to_an_output_changes_no_state_and_no_input(name, steps):
    memory, x, state, flags = problem(name, 2, steps, torch.float32)
    y, after = memory(x, state, flags)
    given = [x.clone(), state.clone(), after.clone()]
    y.add_(1)
    assert torch.equal(x, given[0])
    assert (after == given[2]).all()
    for leaf in after.values():
        leaf.zero_()
    assert torch.equal(x, given[0])
    assert (state == given[1]).all()


def assert_near(ours, theirs, dtype):
    """Equal to 1e-5 in float32 and 1e-12 in float64 of the largest number."""
    scale = float(theirs.abs().max().clamp_min(1e-3))
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(
        ours.double() / scale, theirs.double() / scale, rtol=0, atol=tolerance
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("steps", LENGTHS)
@torch.no_grad()
def test_one_call_equals_many_at_every_length_and_split(name, dtype, steps):
    memory, x, state, flags = problem(name, 2, steps, dtype)
    y, after = memory(x, state, flags)
    one_by_one = list(range(steps)) if steps < 200 else []
    for cuts in ([steps // 2], [steps // 3, steps // 2 + 1], [1, steps - 1], one_by_one):
        borders = sorted({0, steps, *(c for c in cuts if 0 < c < steps)})
        parts, carried = [], state
        for begin, end in itertools.pairwise(borders):
            part, carried = memory(x[:, begin:end], carried, flags[:, begin:end])
            parts.append(part)
        assert_near(torch.cat(parts, 1), y, dtype)
        for key, leaf in after.items():
            assert_near(carried[key].to(dtype), leaf.to(dtype), dtype)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("start", [1, 40, 100])
def test_what_was_before_a_start_has_exactly_no_influence(name, start):
    memory, x, state, flags = problem(name, 2, 132, torch.float32, resets=0.0)
    flags[:, start] = True
    leaves = [leaf.requires_grad_() for leaf in state.values() if leaf.is_floating_point()]
    x = x.clone().requires_grad_()
    y, after = memory(x, state, flags)
    gradients = torch.autograd.grad(
        y[:, start:].square().sum(), [x, *leaves], allow_unused=True, materialize_grads=True
    )
    assert (gradients[0][:, :start] == 0).all() and all(
        (gradient == 0).all() for gradient in gradients[1:]
    )
    _, other, other_state, _ = problem(name, 2, 132, torch.float32)
    changed, changed_after = memory(
        torch.cat([50 * other[:, :start], x[:, start:]], 1), other_state, flags
    )
    assert torch.equal(changed[:, start:], y[:, start:])
    assert all(torch.equal(changed_after[key], leaf) for key, leaf in after.items())


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_not_even_a_nan_or_infinity_crosses_a_start(name, bad):
    memory, x, state, flags = problem(name, 3, 60, torch.float32, resets=0.0)
    flags[:2, [20, 45]] = True
    clean, clean_after = memory(x, state, flags)
    x, poisoned = x.clone(), state.clone()
    x[0, 30, 2] = bad
    for leaf in poisoned.values():
        if leaf.is_floating_point():
            leaf[1] = bad
    y, after = memory(x, poisoned, flags)
    assert torch.equal(y[0, :30], clean[0, :30]) and torch.equal(y[:2, 45:], clean[:2, 45:])
    assert torch.equal(y[1, 20:], clean[1, 20:]) and torch.equal(y[2], clean[2])
    assert all(torch.equal(after[key], leaf) for key, leaf in clean_after.items())
    if bad != bad:
        assert y[0, 30].isnan().any() and (name == "mlp" or y[1, :20].isnan().any())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_several_outputs_at_once_are_those_of_one_after_the_other(name, dtype):
    memory = make_memory(name, 3, 4).to(dtype)
    x = torch.randn(2, 9, 3, dtype=dtype, requires_grad=True)
    is_init = torch.zeros(2, 9, dtype=torch.bool)
    is_init[1, 4] = True
    y, _ = memory(x, memory.initial_state(2), is_init)
    leaves = [x, *memory.parameters()]
    directions = torch.randn(3, *y.shape, dtype=dtype)
    together = torch.autograd.grad(y, leaves, directions, retain_graph=True, is_grads_batched=True)
    for number, direction in enumerate(directions):
        alone = torch.autograd.grad(y, leaves, direction, retain_graph=True)
        torch.testing.assert_close([each[number] for each in together], list(alone))


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_of_parameters_under_vmap_equals_one_model_after_another(name):
    models = [make_memory(name, 3, 6).double() for _ in range(3)]
    x, flags = torch.randn(2, 7, 3, dtype=torch.float64), torch.rand(2, 7) < 0.3
    parameters, _ = torch.func.stack_module_state(models)

    def outputs(parameters):
        return torch.func.functional_call(
            models[0], parameters, (x, models[0].initial_state(2), flags)
        )[0]

    y = torch.vmap(outputs)(parameters)
    gradients = torch.autograd.grad(y.square().sum(), list(parameters.values()))
    for i, model in enumerate(models):
        alone, _ = model(x, model.initial_state(2), flags)
        torch.testing.assert_close(y[i], alone)
        for ours, plain in zip(
            gradients,
            torch.autograd.grad(alone.square().sum(), list(model.parameters())),
            strict=True,
        ):
            torch.testing.assert_close(ours[i], plain)


def compiled_equals_eager(name, backend):
    torch._dynamo.reset()
    memory, x, state, flags = problem(name, 2, 6, torch.float32, resets=0.3)

    def loss(x, state, flags):
        y, after = memory(x, state, flags)
        return y.square().mean(), after

    results = [
        function(x, state, flags)
        for function in (torch.compile(loss, fullgraph=True, backend=backend), loss)
    ]
    torch.testing.assert_close(results[0][0], results[1][0])
    for key, leaf in results[1][1].items():
        torch.testing.assert_close(results[0][1][key], leaf)
    gradients = [torch.autograd.grad(value, list(memory.parameters())) for value, _ in results]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("name", NAMES)
def test_every_model_is_traced_into_one_graph(name):
    compiled_equals_eager(name, "eager")


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
@pytest.mark.parametrize("name", NAMES)
def test_every_model_compiles_into_one_graph_forward_and_backward(name, backend):
    compiled_equals_eager(name, backend)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_no_model_takes_many_times_as_long_as_the_lru(name):
    def seconds(memory):
        began = time.process_time()
        memory(x, memory.initial_state(16), flags)[0].square().mean().backward()
        return time.process_time() - began

    x, flags = torch.randn(16, 132, 512), torch.rand(16, 132) < 0.02
    pair = [make_memory(name, 512, 512), make_memory("lru", 512, 512)]
    times = [[seconds(memory) for memory in pair] for _ in range(8)][1:]
    ours, lru = (min(column) for column in zip(*times, strict=True))
    # no scan; eight numbers a channel; four times the parameters
    limit = {"slstm": 5, "mamba": 6, "gtrxl": 7}.get(name, 3)
    assert ours < limit * lru


def test_states_are_zeros_and_complex_ones_are_real_pairs():
    assert make_memory("lru", 3, 4).initial_state(2)["h"].shape == (2, 4, 2)
    assert make_memory("gru", 3, 4).initial_state((2, 7))["h"].shape == (2, 7, 4)
    assert make_memory("mlp", 3, 4).initial_state(2).is_empty()
    assert all((make_memory(name, 3, 4).initial_state(2) == 0).all() for name in NAMES)


def test_mingru_is_the_papers_equation():
    memory = make_memory("mingru", 3, 4)
    x, h = torch.randn(2, 6, 3), torch.randn(2, 4)
    (w1, w2), (b1, b2) = (
        memory.gate_and_candidate.weight.chunk(2),
        memory.gate_and_candidate.bias.chunk(2),
    )
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
    b, c = (
        torch.complex(memory.input[:, 0], memory.input[:, 1]),
        torch.view_as_complex(memory.output.data).conj(),
    )
    y, state = memory(x, memory.initial_state(2), torch.zeros(2, 6, dtype=torch.bool))
    h = torch.zeros(2, 4, dtype=torch.complex128)
    for t in range(6):
        h = decay * h + memory.gamma.exp() * (x[:, t].to(h.dtype) @ b.T)
        torch.testing.assert_close(y[:, t], (h @ c.T).real + memory.skip * x[:, t])
    torch.testing.assert_close(torch.view_as_complex(state["h"]), h)


def test_lru_starts_inside_the_ring_and_normalised():
    memory = make_memory("lru", 8, 1000, r_min=0.5, r_max=0.9, max_phase=0.3)
    radius, phase = torch.exp(-memory.nu.exp()), memory.theta.exp()
    assert 0.5 <= radius.min() < 0.52 and 0.88 < radius.max() <= 0.9
    assert 0 < phase.min() < 0.01 and 0.29 < phase.max() <= 0.3
    torch.testing.assert_close(memory.gamma.exp(), torch.sqrt(1 - radius**2))
    size = (
        memory.input.detach().square().sum((1, 2)).mean()
    )  # with gamma: white noise has states of size 1
    assert float(size) == pytest.approx(1, abs=0.05)
    assert all(torch.isfinite(p).all() for p in make_memory("lru", 8, 1000).parameters())


def test_an_unknown_name_is_answered_with_the_nearest_and_the_list():
    with pytest.raises(ValueError, match=r"'minigru'.*mean 'mingru'.*lru, mingru, gru, mlp"):
        make_memory("minigru", 3, 4)


def test_names_are_registered_once_and_must_be_identifiers(monkeypatch):
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))

    def factory(input_size, hidden_size, width=1):
        return make_memory("gru", input_size, hidden_size * width)

    register_memory("tests_wide_gru", factory)
    assert "tests_wide_gru" in memory_names()
    assert make_memory("tests_wide_gru", 3, 4, width=2).hidden_size == 8
    with pytest.raises(ValueError, match="already"):
        register_memory("tests_wide_gru", factory)
    register_memory("tests_wide_gru", factory, overwrite=True)
    with pytest.raises(ValueError, match="already"):
        register_memory("fart", factory)
    register_memory("fart", factory, overwrite=True)  # the paper's name of another
    assert make_memory("fart", 3, 4, width=2).hidden_size == 8
    with pytest.raises(ValueError, match="identifier"):
        register_memory("Wide GRU", factory)
    with pytest.raises(ValueError, match="identifier such as 'my_memory', got 3"):
        register_memory(3, factory)
    for number in (3, make_memory("gru", 3, 4)):  # a number, a memory in the place of its class
        with pytest.raises(TypeError, match="a class or function") as error:
            register_memory("tests_number", number)
        assert "\n" not in str(error.value)
    assert str(error.value).endswith("got an instance of GRU: give GRU")
    register_memory("tests_one_size", lambda size: number)
    with pytest.raises(
        TypeError, match=r"'tests_one_size' cannot be made from \(input_size, hidden"
    ):
        make_memory("tests_one_size", 3, 4)


@pytest.mark.parametrize("name", NAMES)
def test_wrong_inputs_get_one_clear_line(name):
    memory = make_memory(name, 3, 4)
    flags = torch.zeros(2, 5, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"x must be \[B, T, 3\]"):
        memory(torch.zeros(2, 5, 7), memory.initial_state(2), flags)
    with pytest.raises(ValueError, match="squeeze"):
        memory(torch.zeros(2, 5, 3), memory.initial_state(2), flags.unsqueeze(-1))
    with pytest.raises(ValueError, match=r"is_init must be bool \[B, T\] = \[2, 5\], got None"):
        memory(torch.zeros(2, 5, 3), memory.initial_state(2), None)
    with pytest.raises(ValueError, match=r"is_init must be bool .* got torch.float32 \[2, 5\]"):
        memory(torch.zeros(2, 5, 3), memory.initial_state(2), flags.float())
    with pytest.raises(
        ValueError, match=r"x is torch.float64 but the parameters are torch.float32"
    ):
        memory(torch.zeros(2, 5, 3, dtype=torch.float64), memory.initial_state(2), flags)
    with pytest.raises(ValueError, match="at least one step"):
        memory(torch.zeros(2, 0, 3), memory.initial_state(2), flags[:, :0])
    other = make_memory("gru" if name in ("lru", "rtu") else "lru", 3, 4).initial_state(2)
    with pytest.raises(
        ValueError, match=r"the state of \w+ must be .* another model or batch size"
    ):
        memory(torch.zeros(2, 5, 3), other, flags)
    if name != "mlp":
        with pytest.raises(
            ValueError, match=r"another model or batch size; begin with initial_state"
        ):
            memory(torch.zeros(2, 5, 3), memory.initial_state(3), flags)
    for wrong in (None, torch.zeros(2, 4)):
        with pytest.raises(ValueError, match="must be a TensorDict, as from initial_state"):
            memory(torch.zeros(2, 5, 3), wrong, flags)
    with torch.autocast("cpu", torch.bfloat16), pytest.raises(ValueError, match="autocast"):
        memory(torch.zeros(2, 5, 3), memory.initial_state(2), flags)
    with pytest.raises(ValueError, match="positive"):
        make_memory(name, 0, 4)


def test_unknown_options_are_refused():
    with pytest.raises(
        TypeError,
        match=r"^memory 'gru' has other options: got an unexpected keyword argument 'foo'$",
    ):
        make_memory("gru", 3, 4, foo=1)
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


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("name", memory_names())
def test_a_memory_of_half_precision_is_the_memory_but_for_rounding(name, dtype):
    """Before: LRU, GDN and TTT failed in torch's words, which has no such complex numbers and no
    such solver.
    """
    memory = make_memory(name, 8, 8)
    x = torch.randn(2, 6, 8)
    is_init = torch.rand(2, 6) < 0.2
    wanted, _ = memory(x, memory.initial_state(2), is_init)
    half = memory.to(dtype)
    y, state = half(x.to(dtype), half.initial_state(2), is_init)
    assert y.dtype == dtype
    again, _ = half(x.to(dtype), state, torch.zeros_like(is_init))
    assert again.isfinite().all()
    assert (y.float() - wanted).norm() < 0.05 * wanted.norm() + 1e-3
    y.float().square().sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in half.parameters())
