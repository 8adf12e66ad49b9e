"""Stable Hadamard Memory is the paper's equations with rows in order; its numbers are pinned."""

import sys
import types

import pytest
import torch
from torch import Tensor

from arcade_torch.models import make_memory
from tests.models.written_out import (
    F64,
    assert_is_written_out,
    file_of,
    pinned_pass,
    problem,
)


def test_it_is_the_papers_equations_with_the_rows_of_theta_in_order() -> None:
    memory, x, state, is_init = problem("shm", rows=4, key_size=3)
    weights = memory.from_input.weight.split([3, 3, 3, 3, 1])
    theta = memory.theta - memory.theta.mean(dim=0)

    def step(x: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        x = memory.norm(x)
        q, k, v, c, eta = (weight @ x for weight in weights)
        q = torch.relu(q)
        k = torch.relu(k)
        q = q / (1e-5 + q.sum())
        k = k / (1e-5 + k.sum())
        gate = 1 + torch.tanh(torch.outer(theta[int(state["step"]) % 4], c))
        h = state["h"] * gate + torch.outer(torch.sigmoid(eta) * v, k)
        return memory.output(h @ q), {"h": h, "step": state["step"] + 1}

    assert_is_written_out(memory, x, state, is_init, step)


def test_a_step_is_that_of_memorax_with_the_row_of_the_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """memorax 1.0.1, JAX, whose cell takes row 0 where it draws none. Its file alone: the package
    imports another that does not know jax 0.10.
    """
    nn = pytest.importorskip("flax.linen")
    utils = types.ModuleType("utils")
    monkeypatch.setattr(utils, "xavier_uniform", nn.initializers.xavier_uniform, raising=False)
    monkeypatch.setitem(sys.modules, "memorax.networks.sequence_models.utils", utils)
    shm = file_of("memorax", "networks/sequence_models/shm.py")
    import jax
    import jax.numpy as jnp
    import numpy as np

    memory = make_memory("shm", 4, 9, rows=5)
    cell = shm.SHMCell(features=3, output_features=9, num_thetas=1)
    x = torch.randn(2, 12, 4)
    theta = (memory.theta - memory.theta.mean(dim=0)).detach().numpy()
    names = ("query", "key", "value", "vc", "eta")
    parameters: dict[str, object] = {
        name: {"kernel": weight.detach().numpy().T}
        for name, weight in zip(names, memory.from_input.weight.split([3, 3, 3, 3, 1]), strict=True)
    }
    norm = {"scale": memory.norm.weight, "bias": memory.norm.bias}
    parameters["ln"] = {name: value.detach().numpy() for name, value in norm.items()}
    kernel = memory.output.weight.detach().numpy().T
    parameters["output"] = {"kernel": kernel, "bias": memory.output.bias.detach().numpy()}
    y, _ = memory(x, memory.initial_state(2), torch.zeros(2, 12, dtype=torch.bool))
    carry = cell.initialize_carry(jax.random.key(0), (2, 4))
    for t in range(12):
        parameters["theta_table"] = theta[[t % 5]]
        carry, wanted = cell.apply({"params": parameters}, carry, jnp.array(x[:, t].numpy()))
        torch.testing.assert_close(y[:, t], torch.tensor(np.array(wanted)), rtol=0, atol=1e-5)


@pytest.mark.parametrize("size", [0.3, 3.0, 30.0])
@torch.no_grad()
def test_no_entry_grows_over_a_cycle_of_rows_if_the_input_stays_the_same(size: float) -> None:
    memory = make_memory("shm", 4, 16, rows=16).to(F64)
    memory.theta.copy_(size * torch.randn(16, 4).exp())  # all positive, some large
    x = torch.randn(5, 1, 4, dtype=F64).expand(-1, 16, -1)
    h = torch.rand(5, 4, 4, dtype=F64) + 0.1
    state = memory.initial_state(5).set("h", h)
    memory.from_input.weight[8:12] = 0  # write nothing: the values are zero
    _, after = memory(x, state, torch.zeros(5, 16, dtype=torch.bool))
    assert (after["h"] <= h * (1 + 1e-12)).all() and (after["h"] >= 0).all()
    assert (after["h"] < h).any()


def test_a_size_that_is_not_positive_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^key_size and rows must be positive, got None and 0$"):
        make_memory("shm", 3, 4, rows=0)


def test_one_forward_pass_is_pinned() -> None:
    y = pinned_pass("shm", key_size=2, rows=2)
    torch.testing.assert_close(y, torch.tensor(PINNED, dtype=F64), rtol=0, atol=1e-7)


PINNED = [[0.00776834, 0.59528932], [0.25072622, 0.50502635], [0.37469114, 0.54473668]]
"""Of NumPy, one step at a time."""
