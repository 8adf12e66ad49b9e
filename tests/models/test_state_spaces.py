"""S5 and Mamba are their papers' equations and others' code; their numbers are pinned."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models import make_memory
from arcade_torch.models.s5 import hippo_frequencies
from tests.models.zoo import F64, assert_each_episode, pinned_pass


def continuous(memory: nn.Module) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lambda [N], Delta [N], B [N, D] and C [H, N] of an S5."""
    rate = torch.complex(-memory.log_decay.exp(), memory.frequency)
    c = torch.complex(memory.output[:, 0], memory.output[:, 1])
    return rate, memory.log_step.exp(), torch.complex(*memory.input), c


@pytest.mark.parametrize("sizes", [(4, 4), (3, 5)])
def test_s5_is_the_papers_equation(sizes: tuple[int, int]) -> None:
    memory = make_memory("s5", *sizes, dt_max=1.0).double()

    def oracle(x: Tensor) -> Tensor:
        rate, step, b, c = continuous(memory)
        decay = torch.exp(rate * step)
        h = torch.zeros_like(rate)
        outputs = []
        for x_t in x:
            h = decay * h + (decay - 1) / rate * (b @ x_t.to(b.dtype))
            skip = memory.skip * x_t if memory.skip.ndim == 1 else memory.skip @ x_t
            outputs.append(2 * (c @ h).real + skip)
        return torch.stack(outputs)

    assert_each_episode(memory, oracle)


def test_s5_is_that_of_s5_pytorch() -> None:
    """Version 0.2.1, one sequence; theirs has no starts inside."""
    theirs = pytest.importorskip("s5.s5_model", reason="needs pip install s5-pytorch")
    memory = make_memory("s5", 4, 4, dt_max=1.0).double()

    def oracle(x: Tensor) -> Tensor:
        rate, step, b, c = continuous(memory)
        decay, given = theirs.discretize_zoh(rate, b, step)
        y: Tensor = theirs.apply_ssm(decay, given, 2 * c, memory.skip, x)[0]
        return y

    assert_each_episode(memory, oracle)


def test_s5_begins_with_the_normal_part_of_hippo_and_one_of_every_pair() -> None:
    n = torch.arange(12, dtype=F64)
    root = (2 * n + 1).sqrt()
    legs = -torch.tril(torch.outer(root, root), -1) - torch.diag(n + 1)
    low_rank = (n + 0.5).sqrt()
    values = torch.linalg.eigvals(legs + torch.outer(low_rank, low_rank))
    torch.testing.assert_close(values.real, torch.full_like(n, -0.5))
    above = values.imag[values.imag > 0].sort().values
    torch.testing.assert_close(torch.tensor(hippo_frequencies(6), dtype=F64), above)

    memory = make_memory("s5", 8, 400)
    assert memory.initial_state(1)["h"].shape == (1, 2, 200)
    rate, step, _, _ = continuous(memory)
    torch.testing.assert_close(rate.real, torch.full((200,), -0.5))
    assert 0.001 <= step.min() < 0.0012 and 0.09 < step.max() <= 0.1


def test_s5_keeps_small_steps_exact_in_single_precision() -> None:
    memory = make_memory("s5", 4, 4, dt_min=1e-5, dt_max=1e-5)
    x = torch.randn(1, 50, 4)
    flags = torch.zeros(1, 50, dtype=torch.bool)
    with torch.no_grad():
        memory.skip.zero_()
        y, _ = memory(x, memory.initial_state(1), flags)
        exact = memory.double()
        wanted, _ = exact(x.double(), exact.initial_state(1), flags)
    assert (y - wanted).norm() < 1e-5 * wanted.norm()


def mamba_oracle(memory: nn.Module, x: Tensor) -> Tensor:
    """One step after the other, one channel after the other, from zeros."""
    width, size, k = memory.width, memory.state_size, memory.conv
    signal, z = (x @ memory.signal_and_gate.weight.T).split(width, dim=-1)
    rate = -memory.log_rate.exp()
    h = torch.zeros(width, size, dtype=x.dtype)
    outputs = []
    for t in range(len(x)):
        conv = memory.taps_bias.clone()
        for age in range(min(k, t + 1)):
            conv += memory.taps[age] * signal[t - age]
        u = F.silu(conv)
        low, b, c = memory.selection(u).split([memory.rank, size, size])
        delta = torch.log1p(torch.exp(memory.step(low)))
        y = memory.skip * u
        for channel in range(width):
            decay = torch.exp(delta[channel] * rate[:, channel])
            h[channel] = decay * h[channel] + delta[channel] * b * u[channel]
            y[channel] += c @ h[channel]
        outputs.append(memory.output(y * F.silu(z[t])))
    return torch.stack(outputs)


@pytest.mark.parametrize("options", [{}, {"state_size": 3, "expand": 2, "conv": 2}])
@pytest.mark.parametrize("sizes", [(4, 4), (3, 5)])
def test_mamba_is_the_papers_equation(sizes: tuple[int, int], options: dict[str, int]) -> None:
    memory = make_memory("mamba", *sizes, **options).double()
    assert_each_episode(memory, lambda x: mamba_oracle(memory, x))


def test_mamba_is_that_of_mambapy() -> None:
    """Version 1.2.0, whose A is float32; theirs has no starts inside."""
    theirs = pytest.importorskip("mambapy.mamba", reason="needs pip install mambapy")
    memory = make_memory("mamba", 6, 6, expand=2)
    config = theirs.MambaConfig(6, 1, d_state=8, expand_factor=2, pscan=False)
    block = theirs.MambaBlock(config)
    weights = {
        "A_log": memory.log_rate.T,
        "D": memory.skip,
        "in_proj.weight": memory.signal_and_gate.weight,
        "conv1d.weight": memory.taps.flip(0).T.unsqueeze(1),
        "conv1d.bias": memory.taps_bias,
        "x_proj.weight": memory.selection.weight,
        "dt_proj.weight": memory.step.weight,
        "dt_proj.bias": memory.step.bias,
        "out_proj.weight": memory.output.weight,
    }
    block.load_state_dict(weights)
    assert_each_episode(memory, lambda x: block(x.unsqueeze(0))[0], tolerance=1e-6)


def test_mamba_begins_as_the_paper_says() -> None:
    memory = make_memory("mamba", 4, 512)
    rates = memory.log_rate.exp()
    torch.testing.assert_close(rates, torch.arange(1.0, 9).unsqueeze(-1).expand(8, 512))
    step = F.softplus(memory.step.bias)
    assert 0.00099 < step.min() < 0.0012 and 0.09 < step.max() < 0.101


def test_what_mamba_convolves_is_state_and_does_not_cross_a_start() -> None:
    memory = make_memory("mamba", 3, 4)
    x = torch.randn(1, 6, 3)
    y, state = memory(x, memory.initial_state(1), torch.zeros(1, 6, dtype=torch.bool))
    signal = memory.signal_and_gate(x)[..., :4]
    torch.testing.assert_close(state["conv"][0], signal[0, [5, 4, 3]])
    begun = torch.zeros(1, 1, dtype=torch.bool)
    after = {}
    for name in ("h", "conv"):
        lacking = state.clone()
        lacking[name].zero_()
        after[name] = memory(x[:, :1], lacking, begun)[0]
    whole, _ = memory(x[:, :1], state, begun)
    fresh, _ = memory(x[:, :1], state, ~begun)
    assert not torch.equal(after["h"], whole) and not torch.equal(after["conv"], whole)
    torch.testing.assert_close(fresh, y[:, :1])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("s5", {"state_size": 3}, "state_size must be even"),
        ("s5", {"dt_min": 0.2}, "need 0 < dt_min <= dt_max"),
        ("mamba", {"conv": 1}, "conv must be at least 2"),
        ("mamba", {"state_size": 0}, "sizes must be positive"),
    ],
)
def test_options_out_of_range_get_one_line(
    name: str, options: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=f"^{message}.*got"):
        make_memory(name, 3, 4, **options)


@pytest.mark.parametrize(
    ("name", "pinned"),
    [
        ("s5", [[0.57212611, -0.03083764], [-0.92864353, 0.19304390], [0.17221616, -0.11182166]]),
        (
            "mamba",
            [[-0.80027670, -0.79615682], [0.02502601, 1.42390343], [7.04124945, -10.26348092]],
        ),
    ],
)
def test_one_forward_pass_is_pinned(name: str, pinned: list[list[float]]) -> None:
    y = pinned_pass(make_memory(name, 2, 2))
    torch.testing.assert_close(y, torch.tensor(pinned, dtype=F64), rtol=0, atol=1e-6)
