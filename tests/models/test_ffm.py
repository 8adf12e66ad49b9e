"""Fast and Forgetful Memory is the paper's equations, its states are memax's; its numbers are pinned."""

import pytest
import torch
from torch import Tensor

from arcade_torch.models import make_memory
from tests.models.written_out import F64, assert_is_written_out, pinned_pass, problem


@pytest.mark.parametrize("options", [{}, {"trace_size": 3, "context_size": 2}])
def test_it_is_the_papers_equations(options: dict[str, int]) -> None:
    memory, x, state, is_init = problem("ffm", **options)
    m, c = memory.trace_size, memory.context_size

    def step(x: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        l1, l2 = memory.write(x).split(m)
        written = l1 * torch.sigmoid(l2)
        after = torch.zeros(m, c, 2, dtype=F64)
        for j in range(m):
            for k in range(c):
                factor = torch.exp(torch.complex(-memory.alpha[j].abs(), memory.omega[k]))
                before = torch.complex(*state["h"][j, k])
                value = factor * before + written[j]
                after[j, k] = torch.stack([value.real, value.imag])
        z = memory.mix(after.flatten())
        z = (z - z.mean()) / torch.sqrt(z.var(correction=0) + 1e-5)
        l4, l5 = memory.gate_and_skip(x).chunk(2)
        return z * torch.sigmoid(l4) + l5 * (1 - torch.sigmoid(l4)), {"h": after}

    assert_is_written_out(memory, x, state, is_init, step)


def test_traces_span_two_steps_to_a_thousand_and_contexts_have_the_published_periods() -> None:
    memory = make_memory("ffm", 4, 64)
    alpha = memory.alpha.detach()
    kept = torch.exp(-1024 * alpha)
    assert alpha.shape == (8,)
    assert float(kept[0]) == pytest.approx(0.01, rel=1e-3)
    assert float(alpha[-1]) == pytest.approx(0.5)
    periods = 2 * torch.pi / memory.omega.detach()
    torch.testing.assert_close(periods, torch.tensor([1.0, 342.0, 683.0, 1024.0]))


def test_a_size_that_is_not_positive_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^trace_size and context_size must be positive, got 0 "):
        make_memory("ffm", 3, 4, trace_size=0)


def test_its_states_are_those_of_memax() -> None:
    """memax 0.1.1, JAX. Its output is another: it gates before the layer norm, the paper after."""
    ffm = pytest.importorskip("memax.equinox.semigroups.ffm")
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    theirs = ffm.FFM(hidden_size=6, trace_size=3, context_size=4, key=jax.random.key(0))
    ours = make_memory("ffm", 6, 6, trace_size=3, context_size=4)
    alpha = ours.alpha.detach().numpy()
    omega = ours.omega.detach().numpy()
    theirs = eqx.tree_at(lambda t: t.algebra.algebra.params, theirs, (alpha, omega))

    def both(first: object, second: object) -> Tensor:
        return torch.tensor(np.concatenate([np.array(first), np.array(second)]))

    with torch.no_grad():
        gate = theirs.gate_in.linear
        ours.write.weight.copy_(both(theirs.pre.weight, gate.weight))
        ours.write.bias.copy_(both(theirs.pre.bias, gate.bias))
    x = torch.randn(1, 20, 6)
    is_init = torch.zeros(1, 20, dtype=torch.bool)
    is_init[0, 8] = True
    _, states = ours.run(x, ours.initial_state(1)["h"], is_init)
    steps = (jnp.array(x[0].numpy()), jnp.array(is_init[0].numpy()))
    ((wanted, _), _), _ = theirs(theirs.initialize_carry(), steps)
    torch.testing.assert_close(
        torch.view_as_complex(states[0].detach()), torch.tensor(np.array(wanted)), rtol=0, atol=1e-5
    )


def test_one_forward_pass_is_pinned() -> None:
    y = pinned_pass("ffm", trace_size=1, context_size=2)
    torch.testing.assert_close(y, torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-7)


PINNED = [[-1.08460660, 0.61301960], [-0.20641551, 0.00759038], [-0.71141066, -0.00259442]]
"""Of NumPy, one step at a time."""
