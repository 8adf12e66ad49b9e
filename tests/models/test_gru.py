"""The GRU's loop as one operator: values and gradients of the plain loop, also under vmap."""

import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.models import make_memory
from arcade_torch.models.gru import gru_loop, gru_scan, gru_scan_backward

F64 = torch.float64


def problem(batch=2, steps=5, size=3, resets=0.3, every=True):
    """Random arguments of the scan, with a start at index 0, and a state to load for every step or
    for index 0 alone.
    """
    states = (batch, steps if every else 1, size)
    inputs = 2
    shapes = (
        (batch, steps, inputs),
        (3 * size, inputs),
        (3 * size,),
        (2 * size, size),
        (size, size),
        states,
    )
    x, *weights, stored = (torch.randn(shape, dtype=F64, requires_grad=True) for shape in shapes)
    start = torch.rand(batch, steps) < resets
    start[:, 0] = True
    return x, *weights, start, stored


def leaves(arguments):
    return [x for x in arguments if x.requires_grad]


@given(
    batch=st.integers(1, 3),
    steps=st.integers(1, 12),
    size=st.integers(1, 5),
    resets=st.sampled_from([0.0, 0.2, 1.0]),
    every=st.booleans(),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=40, deadline=None)
def test_the_operator_equals_the_loop_values_and_gradients(batch, steps, size, resets, every, seed):
    torch.manual_seed(seed)
    arguments = problem(batch, steps, size, resets, every)
    ours, plain = gru_scan(*arguments)[0], gru_loop(*arguments)[0]
    torch.testing.assert_close(ours, plain, rtol=0, atol=1e-14)
    direction = torch.randn_like(plain)
    found, wanted = (torch.autograd.grad(y, leaves(arguments), direction) for y in (ours, plain))
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("mapped", [tuple(range(7)), (1, 2, 3, 4), (0,), (6,)])
def test_vmap_over_any_of_the_arguments_equals_one_after_the_other(mapped):
    problems = [problem() for _ in range(3)]
    dims = tuple(0 if i in mapped else None for i in range(7))
    stacked = [
        torch.stack([p[i] for p in problems]) if d == 0 else problems[0][i]
        for i, d in enumerate(dims)
    ]
    rows = [[p[i] if d == 0 else problems[0][i] for i, d in enumerate(dims)] for p in problems]
    y = torch.vmap(lambda *a: gru_scan(*a)[0], in_dims=dims)(*stacked)
    alone = torch.stack([gru_loop(*row)[0] for row in rows])
    torch.testing.assert_close(y, alone)
    weights = [problems[0][i] for i in (0, 1, 2, 3, 4, 6)]
    direction = torch.randn_like(y)
    found, wanted = (torch.autograd.grad(out, weights, direction) for out in (y, alone))
    torch.testing.assert_close(found, wanted)


def test_opcheck_finds_nothing():
    arguments = problem()
    torch.library.opcheck(gru_scan, arguments)
    with torch.no_grad():
        made = gru_scan(*arguments)
    torch.library.opcheck(
        gru_scan_backward, (*(x.detach() for x in arguments[3:]), *made, torch.randn_like(made[0]))
    )


@pytest.mark.slow
def test_both_passes_take_no_longer_than_those_of_torchs_gru():
    """64 sequences of 32 steps, 32 features in and 128 out, one thread: in turn, the least of each
    counts.
    """
    x = torch.randn(64, 32, 32)
    is_init = torch.zeros(64, 32, dtype=torch.bool)
    ours = make_memory("gru", 32, 128)
    theirs = torch.nn.GRU(32, 128, batch_first=True)
    begin = ours.initial_state(64)
    reads = {"ours": lambda: ours(x, begin, is_init)[0], "torch": lambda: theirs(x)[0]}
    times = {name: [] for name in reads}
    for _ in range(40):
        for name, read in reads.items():
            began = time.process_time()
            read().sum().backward()
            times[name].append(time.process_time() - began)
    assert min(times["ours"]) < min(times["torch"])
