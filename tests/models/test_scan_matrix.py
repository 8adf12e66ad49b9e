"""The matrix-valued scan: every chunk size equals the plain loop, gradients too; nothing grows,
overflows or leaks.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from arcade_torch.models.scan_matrix import (
    MatrixSteps,
    matrix_scan,
    matrix_scan_loop,
    matrix_scan_stored,
)

KINDS = ["sum", "decay", "delta", "gated delta"]


def problem(kind, batch=2, length=7, keys=3, values=4, dtype=torch.float64, resets=0.2):
    """Random steps with unit keys, flags and a state."""
    query, key = (
        torch.nn.functional.normalize(torch.randn(batch, length, keys, dtype=dtype), dim=-1)
        for _ in "qk"
    )
    erase = 2 * torch.rand(batch, length, 1, dtype=dtype) if "delta" in kind else None
    decay = torch.nn.functional.logsigmoid(2 * torch.randn(batch, length, 1, dtype=dtype))
    steps = MatrixSteps(
        query,
        key,
        torch.randn(batch, length, values, dtype=dtype),
        erase,
        decay if kind in KINDS[1::2] else None,
    )
    return steps, torch.rand(batch, length) < resets, torch.randn(batch, keys, values, dtype=dtype)


def cut(steps, where):
    return MatrixSteps(*(None if x is None else x[:, where] for x in steps))


def leaves(steps, h0):
    return [x.requires_grad_() for x in (*steps, h0) if x is not None]


@given(
    kind=st.sampled_from(KINDS),
    length=st.integers(1, 40),
    chunk=st.integers(1, 41),
    resets=st.sampled_from([0.0, 0.2, 1.0]),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=60, deadline=None)
def test_every_chunk_size_equals_the_loop_values_and_gradients(kind, length, chunk, resets, seed):
    torch.manual_seed(seed)
    steps, start, h0 = problem(kind, length=length, resets=resets)
    inputs = leaves(steps, h0)
    o, last = matrix_scan(steps, start, h0, chunk=chunk)
    looped, states = matrix_scan_loop(steps, start, h0)
    torch.testing.assert_close(o, looped, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(last, states[:, -1], rtol=1e-12, atol=1e-12)
    weight, ending = torch.randn_like(o), torch.randn_like(last)
    ours = torch.autograd.grad((o * weight).sum() + (last * ending).sum(), inputs)
    plain = torch.autograd.grad((looped * weight).sum() + (states[:, -1] * ending).sum(), inputs)
    for p, q in zip(ours, plain, strict=True):
        torch.testing.assert_close(p, q, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("length", [1, 2, 3, 7, 128, 132, 1000])
def test_odd_and_long_sequences_equal_the_loop(kind, dtype, tolerance, length):
    steps, start, h0 = problem(kind, length=length, keys=23, values=23, dtype=dtype, resets=0.01)
    o, last = matrix_scan(steps, start, h0)
    looped, states = matrix_scan_loop(steps, start, h0)
    for ours, plain in ((o, looped), (last, states[:, -1])):
        scale = plain.abs().max()
        torch.testing.assert_close(ours / scale, plain / scale, rtol=0, atol=tolerance)


@given(
    kind=st.sampled_from(KINDS),
    cuts=st.lists(st.integers(1, 29), max_size=4, unique=True),
    chunk=st.integers(1, 12),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=30, deadline=None)
def test_pieces_with_a_carried_state_equal_the_whole(kind, cuts, chunk, seed):
    torch.manual_seed(seed)
    steps, start, h0 = problem(kind, length=30)
    o, last = matrix_scan(steps, start, h0, chunk=chunk)
    parts, state = [], h0
    for begin, end in zip([0, *sorted(cuts)], [*sorted(cuts), 30], strict=True):
        part, state = matrix_scan(
            cut(steps, slice(begin, end)), start[:, begin:end], state, chunk=chunk
        )
        parts.append(part)
    torch.testing.assert_close(torch.cat(parts, 1), o, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(state, last, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("length", [1, 2, 9, 70])
def test_stored_states_are_loaded_at_index_zero_and_at_starts_and_all_states_come_back(
    kind, length
):
    steps, start, _ = problem(kind, batch=3, length=length)
    stored = torch.randn(3, length, 3, 4, dtype=torch.float64)
    o, states = matrix_scan_stored(steps, start, stored)
    looped, looped_states = matrix_scan_loop(steps, start, stored)
    torch.testing.assert_close(o, looped, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(states, looped_states, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_equal_finite_differences_across_chunks_and_starts(kind):
    steps, start, h0 = problem(kind, batch=1, length=5, keys=2, values=2)
    start[:] = torch.tensor([False, False, False, True, False])
    names = [name for name, x in steps._asdict().items() if x is not None]

    def outputs(h0, *given):
        return matrix_scan(
            steps._replace(**dict(zip(names, given, strict=True))), start, h0, chunk=2
        )

    inputs = leaves(steps, h0)
    assert torch.autograd.gradcheck(outputs, (inputs[-1], *inputs[:-1]))


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_crosses_a_start_not_even_rounding(kind):
    steps, start, h0 = problem(kind, length=50, dtype=torch.float32, resets=0.0)
    start[:, 21] = True
    other, _, other_h0 = problem(kind, length=50, dtype=torch.float32)
    other = other._replace(value=100 * other.value)
    mixed = MatrixSteps(
        *(
            None if x is None else torch.cat([y[:, :21], x[:, 21:]], 1)
            for x, y in zip(steps, other, strict=True)
        )
    )
    inputs = leaves(steps, h0)
    o, last = matrix_scan(steps, start, h0, chunk=8)
    changed, changed_last = matrix_scan(mixed, start, other_h0, chunk=8)
    assert torch.equal(o[:, 21:], changed[:, 21:]) and torch.equal(last, changed_last)
    grads = torch.autograd.grad(o[:, 21:].sum() + last.sum(), inputs)
    assert (grads[-1] == 0).all() and all((grad[:, :21] == 0).all() for grad in grads[:-1])


@pytest.mark.parametrize("where", ["key", "value", "erase", "log_decay"])
def test_a_nan_in_what_a_step_does_loses_the_rest_of_its_episode_and_nothing_else(where):
    steps, start, h0 = problem("gated delta", length=12, resets=0.0)
    start[:, 7] = True
    clean, clean_last = matrix_scan(steps, start, h0, chunk=5)
    given = getattr(steps, where).clone()
    given[0, 3] = torch.nan
    o, last = matrix_scan(steps._replace(**{where: given}), start, h0, chunk=5)
    assert o[0, 3:7].isnan().all() and o.isnan().any(-1).sum() == 4
    kept = ~o.isnan()
    assert torch.equal(o[kept], clean[kept]) and torch.equal(last, clean_last)


@pytest.mark.parametrize("where", ["key", "value", "erase", "log_decay"])
def test_with_stored_states_it_loses_the_states_of_its_episode_too(where):
    """A replay would store them, and read them as good ones."""
    steps, start, _ = problem("gated delta", length=12, resets=0.0)
    start[:, 7] = True
    stored = torch.randn(2, 12, 3, 4, dtype=torch.float64)
    clean, clean_states = matrix_scan_stored(steps, start, stored)
    given = getattr(steps, where).clone()
    given[0, 3] = torch.nan
    o, states = matrix_scan_stored(steps._replace(**{where: given}), start, stored)
    for found, right in ((o, clean), (states.flatten(2), clean_states.flatten(2))):
        assert found[0, 3:7].isnan().all()
        assert torch.equal(found[0, 7:], right[0, 7:]) and torch.equal(found[1], right[1])


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_state_that_is_not_finite_loses_its_episode_and_nothing_else(value):
    steps, start, h0 = problem("gated delta", length=12, resets=0.0)
    start[:, 7] = True
    clean, clean_last = matrix_scan(steps, start, h0, chunk=5)
    h0[0, 1, 2] = value
    o, last = matrix_scan(steps, start, h0, chunk=5)
    assert o[0, :7].isnan().all()
    assert torch.equal(o[0, 7:], clean[0, 7:]) and torch.equal(o[1], clean[1])
    assert torch.equal(last, clean_last)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("where", ["key", "value", "erase", "log_decay"])
def test_an_episode_that_is_lost_at_the_end_loses_the_state_that_is_carried_on(where, value):
    """The next call would take it for a good one."""
    steps, start, h0 = problem("gated delta", length=12, resets=0.0)
    start[:, 7] = True
    clean, clean_last = matrix_scan(steps, start, h0, chunk=5)
    given = getattr(steps, where).clone()
    given[0, 9] = value
    o, last = matrix_scan(steps._replace(**{where: given}), start, h0, chunk=5)
    assert o[0, 9:].isnan().all() and last[0].isnan().all()
    assert torch.equal(o[0, :9], clean[0, :9]) and torch.equal(last[1], clean_last[1])


@pytest.mark.parametrize("kind", ["decay", "gated delta"])
@pytest.mark.parametrize("chunk", [1, 5, 12])
def test_a_decay_of_minus_infinity_forgets_everything_and_loses_nothing(kind, chunk):
    steps, start, h0 = problem(kind, length=12, resets=0.0)
    steps.log_decay[:, 4] = -torch.inf
    o, last = matrix_scan(steps, start, h0, chunk=chunk)
    looped, states = matrix_scan_loop(steps, start, h0)
    torch.testing.assert_close(o, looped, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(last, states[:, -1], rtol=1e-12, atol=1e-12)


def test_a_nan_in_the_state_does_not_come_through_a_start():
    steps, start, h0 = problem("gated delta", length=9)
    start[:, 0] = True
    o, last = matrix_scan(steps, start, torch.full_like(h0, torch.nan), chunk=4)
    assert torch.isfinite(o).all() and torch.isfinite(last).all()


@pytest.mark.parametrize("length", [1, 40])
def test_vanishing_decays_neither_overflow_nor_poison_the_gradient(length):
    steps, start, h0 = problem("gated delta", length=length, dtype=torch.float32)
    steps = steps._replace(log_decay=torch.full_like(steps.log_decay, -500.0))
    inputs = leaves(steps, h0)
    o, last = matrix_scan(steps, start, h0)
    only_now = (steps.query * steps.key).sum(-1, keepdim=True) * steps.value
    torch.testing.assert_close(o, only_now)
    assert all(
        torch.isfinite(grad).all() for grad in torch.autograd.grad(o.sum() + last.sum(), inputs)
    )


def test_erasing_twice_what_is_there_stays_bounded_over_a_thousand_equal_keys():
    steps, start, h0 = problem("delta", length=1000, dtype=torch.float32, resets=0.0)
    key = steps.key[:, :1].expand(-1, 1000, -1)
    steps = steps._replace(
        key=key, query=key, erase=torch.full_like(steps.erase, 2.0), value=0 * steps.value
    )
    o, _ = matrix_scan(steps, start, h0)
    remembered = torch.einsum("bk,bkv->bv", key[:, 0], h0)
    torch.testing.assert_close(
        o[:, 0::2], -remembered[:, None].expand(-1, 500, -1), rtol=1e-3, atol=1e-3
    )
    torch.testing.assert_close(
        o[:, 1::2], remembered[:, None].expand(-1, 500, -1), rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("kind", KINDS)
def test_no_state_per_step_is_kept_for_the_backward_pass(kind):
    steps, start, h0 = problem(kind, batch=1, length=1024, keys=16, values=16, dtype=torch.float32)
    leaves(steps, h0)
    sizes = []
    with torch.autograd.graph.saved_tensors_hooks(
        lambda x: (sizes.append(x.numel()), x)[1], lambda x: x
    ):
        matrix_scan(steps, start, h0)
    assert sizes and max(sizes) < 1024 * 16 * 16 / 4


def test_without_erasing_or_decay_it_is_a_sum_and_the_last_state_is_keys_times_values():
    steps, start, h0 = problem("sum", length=100, resets=0.0)
    _, last = matrix_scan(steps, start, h0)
    torch.testing.assert_close(last, h0 + steps.key.mT @ steps.value)


def test_a_full_write_is_recalled_exactly_and_replaces_what_stood_there():
    steps, start, h0 = problem("delta", length=2, resets=0.0)
    key = steps.key[:, :1].expand(-1, 2, -1)
    o, _ = matrix_scan(MatrixSteps(key, key, steps.value, torch.ones_like(steps.erase)), start, h0)
    torch.testing.assert_close(o, steps.value)
