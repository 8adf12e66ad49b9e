"""The linear scan: every form equals the plain loop, and its derivatives equal finite
differences.
"""

from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.models import scan as scan_ops
from arcade_torch.models import scan_triton
from arcade_torch.models.scan import (
    back_end,
    linear_scan,
    scan,
    scan_backward,
    scan_backward_doubling,
    scan_doubling,
)
from tests.models.scan_cases import assert_nothing_crosses_a_start, linear_scan_loop

DTYPES = [torch.float64, torch.complex128]


def problem(batch=2, steps=7, features=(3,), dtype=torch.float64, resets=0.3, grad=False):
    """Random (a, b, start, h0) with |a| about 1."""
    a, b, h0 = (
        torch.randn(batch, *rest, *features, dtype=dtype) for rest in ((steps,), (steps,), ())
    )
    start = torch.rand(batch, steps) < resets
    for x in (a, b, h0):
        x.requires_grad_(grad)
    return a, b, start, h0


@given(
    batch=st.integers(1, 4),
    steps=st.integers(1, 20),
    features=st.sampled_from([(), (1,), (3,), (2, 3)]),
    dtype=st.sampled_from([torch.float32, torch.float64, torch.complex64, torch.complex128]),
    resets=st.sampled_from([0.0, 0.2, 1.0]),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=60, deadline=None)
def test_scan_equals_the_loop(batch, steps, features, dtype, resets, seed):
    torch.manual_seed(seed)
    a, b, start, h0 = problem(batch, steps, features, dtype, resets)
    tolerance = 1e-4 if dtype in (torch.float32, torch.complex64) else 1e-10
    for flags in (start, None):
        for state in (h0, None):
            torch.testing.assert_close(
                linear_scan(a, b, flags, state),
                linear_scan_loop(a, b, flags, state),
                rtol=tolerance,
                atol=tolerance,
            )


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("steps", [1, 2, 3, 8, 13])
def test_the_doubling_form_equals_the_serial_form_forward_and_backward(dtype, steps):
    a, b, start, h0 = problem(3, steps, (2,), dtype)
    for flags in (start, None):
        h = scan(a, b, flags, h0)
        torch.testing.assert_close(scan_doubling(a, b, flags, h0), h)
        grad = torch.randn_like(h)
        for ours, serial in zip(
            scan_backward_doubling(a, flags, h0, h, grad),
            scan_backward(a, flags, h0, h, grad),
            strict=True,
        ):
            torch.testing.assert_close(ours, serial)


@pytest.mark.parametrize("shape", [(3,), (1, 1, 3), (1, 7, 3), (2, 1, 3), (1,), ()])
def test_factors_broadcast_over_batch_and_time(shape):
    _, b, start, h0 = problem()
    a = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    h, loop = linear_scan(a, b, start, h0), linear_scan_loop(a, b, start, h0)
    torch.testing.assert_close(h, loop)
    grad = torch.randn_like(h)
    torch.testing.assert_close(
        torch.autograd.grad(h, a, grad)[0], torch.autograd.grad(loop, a, grad)[0]
    )


@pytest.mark.parametrize("steps", [1, 5])
def test_factors_inputs_and_states_of_several_dtypes_meet_in_the_widest(steps):
    real = torch.rand(2, steps, 3, dtype=torch.float64)
    other = torch.randn(2, steps, 3, dtype=torch.complex128)
    h0 = torch.randn(2, 3)
    for a, b in ((real, other), (other, real)):
        h = linear_scan(a, b, None, h0)
        assert h.dtype == torch.complex128
        wide = [x.to(other.dtype) for x in (a, b, h0)]
        torch.testing.assert_close(h, linear_scan_loop(*wide[:2], None, wide[2]))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("steps", [1, 2, 5])
def test_gradients_equal_finite_differences_with_resets_inside(dtype, steps):
    a, b, start, h0 = problem(2, steps, (2,), dtype, grad=True)
    start[0, steps // 2] = True
    start[1] = False
    assert torch.autograd.gradcheck(lambda a, b, h0: linear_scan(a, b, start, h0), (a, b, h0))
    assert torch.autograd.gradcheck(lambda a, b: linear_scan(a, b), (a, b))


@pytest.mark.parametrize("dtype", DTYPES)
def test_second_derivatives_equal_finite_differences(dtype):
    a, b, start, h0 = problem(2, 4, (2,), dtype, grad=True)
    start[0, 2] = True
    assert torch.autograd.gradgradcheck(lambda a, b, h0: linear_scan(a, b, start, h0), (a, b, h0))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_state_per_position_is_loaded_at_index_zero_and_at_starts(dtype):
    a, b, start, _ = problem(3, 9, (2,), dtype, grad=True)
    stored = torch.randn(3, 9, 2, dtype=dtype, requires_grad=True)
    for flags in (start, None):
        torch.testing.assert_close(
            linear_scan(a, b, flags, stored), linear_scan_loop(a, b, flags, stored)
        )
    start[:, 4], start[:, 5:] = True, False
    whole = linear_scan(a, b, start, stored)
    elsewhere = ~(start | (torch.arange(9) == 0))
    unread = stored.detach().masked_fill(elsewhere[..., None], torch.nan)
    assert torch.equal(linear_scan(a, b, start, unread), whole)
    torch.testing.assert_close(whole[:, 4:], linear_scan(a[:, 4:], b[:, 4:], None, stored[:, 4]))
    assert torch.autograd.gradcheck(
        lambda a, b, s: linear_scan(a, b, start, s), (a, b, stored), fast_mode=True
    )


def test_one_step_at_a_time_equals_one_call():
    a, b, start, h0 = problem(2, 6, (3,))
    h, states = h0, []
    for t in range(6):
        h = linear_scan(a[:, t : t + 1], b[:, t : t + 1], start[:, t : t + 1], h)[:, 0]
        states.append(h)
    torch.testing.assert_close(torch.stack(states, 1), linear_scan(a, b, start, h0))
    b0 = b[:, :1]
    assert torch.equal(linear_scan(a[:, :1], b0).zero_() + b0, b0) and b0.any()  # b is the caller's


@pytest.mark.parametrize(
    "form", [linear_scan, linear_scan_loop, lambda a, b, s, h: scan_doubling(a, b, s, h)]
)
@pytest.mark.parametrize("steps", [1, 6])
def test_nan_before_a_start_does_not_come_through(form, steps):
    a, b, start, h0 = problem(1, 6, (3,), resets=0.0)
    start[:, 6 - steps] = True
    h0[:] = torch.nan
    a, b, start = (x[:, 6 - steps :] if steps == 1 else x for x in (a, b, start))
    assert torch.isfinite(form(a, b, start, h0)).all()
    b = b.clone()
    if steps > 1:
        b[:, 2] = torch.nan
        start[:, 4] = True
        h = form(a, b, start, h0)
        assert torch.isnan(h[:, 2:4]).all() and torch.isfinite(h[:, 4:]).all()


def test_gradients_stop_at_a_start():
    a, b, start, h0 = problem(1, 6, (3,), resets=0.0, grad=True)
    start[:, 3] = True
    grad_a, grad_b, grad_h0 = torch.autograd.grad(
        linear_scan(a, b, start, h0)[:, 3:].sum(), (a, b, h0)
    )
    assert (grad_a[:, :4] == 0).all() and (grad_b[:, :3] == 0).all() and (grad_h0 == 0).all()
    assert (grad_a[:, 4:] != 0).all() and (grad_b[:, 3:] != 0).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("where", [1, 9, 19])
@pytest.mark.parametrize("name", ["serial", "doubling"])
def test_nothing_that_is_put_before_a_start_crosses_it_in_any_form(name, where, dtype):
    with back_end(name):
        assert_nothing_crosses_a_start(where, dtype)


def test_not_even_second_derivatives_see_a_nan_before_a_start():
    a, b, start, h0 = problem(2, 4, (2,), grad=True)
    start[:, 0] = True
    seconds = []
    for state in (h0, torch.full_like(h0, torch.nan)):
        h = linear_scan(a, b, start, state)
        (first,) = torch.autograd.grad(h.square().sum(), a, create_graph=True)
        seconds.append(torch.autograd.grad(first.square().sum(), (a, b)))
    for clean, poisoned in zip(*seconds, strict=True):
        assert torch.equal(clean, poisoned)


@pytest.mark.parametrize("dtype", DTYPES)
def test_vmap_equals_a_python_loop_values_and_gradients(dtype):
    a, b, start, h0 = problem(4, 5, (3,), dtype)
    batched = [x.unflatten(0, (2, 2)) for x in (a, b, start, h0)]
    mapped = torch.vmap(linear_scan)(*batched)
    torch.testing.assert_close(mapped.flatten(0, 1), linear_scan(a, b, start, h0))
    some = torch.vmap(linear_scan, in_dims=(None, 0, None, None))(
        a[:2], b.unflatten(0, (2, 2)), start[:2], h0[:2]
    )
    torch.testing.assert_close(some[1], linear_scan(a[:2], b[2:], start[:2], h0[:2]))
    last = [x.movedim(0, -1) for x in batched]
    torch.testing.assert_close(torch.vmap(linear_scan, in_dims=-1)(*last), mapped)

    leaves = [x.clone().requires_grad_() for x in (a, b, h0)]
    plain = torch.autograd.grad(
        linear_scan(*leaves[:2], start, leaves[2]).abs().square().sum(), leaves
    )
    split = [x.unflatten(0, (2, 2)) for x in (*leaves[:2], start, leaves[2])]
    through_vmap = torch.autograd.grad(torch.vmap(linear_scan)(*split).abs().square().sum(), leaves)
    for mapped_grad, grad in zip(through_vmap, plain, strict=True):
        torch.testing.assert_close(mapped_grad, grad)


@pytest.mark.parametrize("dtype", DTYPES)
def test_many_gradients_in_one_batched_call_equal_one_at_a_time(dtype):
    a, b, start, h0 = problem(2, 5, (3,), dtype, grad=True)
    h = linear_scan(a, b, start, h0)
    directions = torch.randn(4, *h.shape, dtype=dtype)
    together = torch.autograd.grad(
        h, (a, b, h0), directions, is_grads_batched=True, retain_graph=True
    )
    for k, direction in enumerate(directions):
        for ours, alone in zip(
            together, torch.autograd.grad(h, (a, b, h0), direction, retain_graph=True), strict=True
        ):
            torch.testing.assert_close(ours[k], alone)


@pytest.mark.parametrize("dtype", [torch.float32, torch.complex64])
def test_opcheck_finds_nothing(dtype):
    a, b, start, h0 = problem(2, 4, (3,), dtype, grad=True)
    torch.library.opcheck(scan, (a, b, start, h0))
    torch.library.opcheck(scan, (a, b, None, h0))
    time_first = torch.randn(4, 2, 3, dtype=dtype).transpose(0, 1)
    torch.library.opcheck(scan, (a, time_first, start, h0))
    with torch.no_grad():
        h = scan(a, b, start, h0)
    for grad in (torch.randn_like(h), time_first):
        torch.library.opcheck(scan_backward, (a, start, h0, h, grad))


@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_it_compiles_into_one_graph(backend):
    a, b, start, h0 = problem(2, 6, (3,), torch.float32, grad=True)

    def loss(a, b, h0):
        return linear_scan(torch.sigmoid(a), b, start, h0).square().sum()

    compiled = torch.compile(loss, fullgraph=True, backend=backend)
    torch.testing.assert_close(compiled(a, b, h0), loss(a, b, h0))
    for ours, eager in zip(
        torch.autograd.grad(compiled(a, b, h0), (a, b, h0)),
        torch.autograd.grad(loss(a, b, h0), (a, b, h0)),
        strict=True,
    ):
        torch.testing.assert_close(ours, eager)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": torch.zeros(2, 5, 1, dtype=torch.bool)}, "squeeze"),
        ({"start": torch.zeros(2, 5)}, "bool"),
        ({"h0": torch.zeros(3, 3)}, "h0"),
        ({"a": torch.zeros(4)}, "broadcast"),
        ({"a": torch.zeros(1, 2, 5, 3)}, "broadcast"),
        ({"b": torch.zeros(2)}, "T >= 1"),
        ({"a": torch.zeros(2, 0, 3), "b": torch.zeros(2, 0, 3)}, "T >= 1"),
    ],
)
def test_wrong_shapes_get_one_clear_line(change, message):
    arguments = {"a": torch.zeros(2, 5, 3), "b": torch.zeros(2, 5, 3)} | change
    with pytest.raises(ValueError, match=message):
        linear_scan(**arguments)


@pytest.mark.parametrize("installed", [True, False])
def test_a_card_runs_triton_where_it_can_and_the_doubling_form_elsewhere(installed, monkeypatch):
    monkeypatch.setattr(scan_triton, "_kernels", lambda: object() if installed else None)
    for dtype in (torch.float32, torch.float64, torch.complex64, torch.complex128, torch.bfloat16):
        on_card = "triton" if installed and dtype != torch.bfloat16 else "doubling"
        assert scan_ops._back_end_of(SimpleNamespace(is_cuda=True, dtype=dtype)) == on_card
        assert scan_ops._back_end_of(SimpleNamespace(is_cuda=False, dtype=dtype)) == "serial"


def test_a_back_end_can_be_chosen_for_a_while_and_a_wrong_one_is_refused():
    a, b, start, h0 = problem(grad=True)
    with pytest.raises(ValueError, match="serial, doubling, triton"), back_end("parallel"):
        pass
    expected = linear_scan(a, b, start, h0)
    grads = torch.autograd.grad(expected.sum(), (a, b, h0))
    with pytest.raises(KeyError), back_end("doubling"):
        found = linear_scan(a, b, start, h0)
        torch.testing.assert_close(found, expected)
        for ours, theirs in zip(torch.autograd.grad(found.sum(), (a, b, h0)), grads, strict=True):
            torch.testing.assert_close(ours, theirs)
        with back_end("serial"):
            pass
        assert scan_ops._back_end_of(b) == "doubling"
        raise KeyError
    assert scan_ops._back_end_of(b) == "serial"
