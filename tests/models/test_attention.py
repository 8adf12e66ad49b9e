"""Sliding-window attention: blocks equal the plain loop and the textbook; the window, the cache and
positions.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from arcade_torch.models import MemoryLawError, check_memory, make_memory
from arcade_torch.models.attention import window_attention, window_attention_loop
from arcade_torch.models.rotary import angles, rotate, rotate_pairs

F64 = torch.float64


def flags(batch, length, *starts):
    out = torch.zeros(batch, length, dtype=torch.bool)
    out[:, list(starts)] = True
    return out


@given(
    length=st.integers(1, 40),
    window=st.integers(1, 20),
    block=st.integers(1, 41),
    width=st.integers(1, 6),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=50, deadline=None)
def test_every_block_size_equals_the_loop_values_and_gradients(length, window, block, width, seed):
    torch.manual_seed(seed)
    query = torch.randn(2, length, width, dtype=F64, requires_grad=True)
    key, value = (
        torch.randn(2, window - 1 + length, width, dtype=F64, requires_grad=True) for _ in "kv"
    )
    episode = torch.cat(
        [torch.randint(-1, 1, (2, window - 1)), (torch.rand(2, length) < 0.2).cumsum(1)], 1
    )
    y = window_attention(query, key, value, episode, window, block=block)
    loop = window_attention_loop(query, key, value, episode, window)
    torch.testing.assert_close(y, loop, rtol=1e-12, atol=1e-12)
    weight = torch.randn_like(y)
    for ours, plain in zip(
        torch.autograd.grad(y, (query, key, value), weight),
        torch.autograd.grad(loop, (query, key, value), weight),
        strict=True,
    ):
        torch.testing.assert_close(ours, plain, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (F64, 1e-12)])
@pytest.mark.parametrize("length", [1, 2, 3, 7, 128, 132, 1000])
def test_odd_and_long_sequences_equal_the_loop(dtype, tolerance, length):
    query, key, value = (torch.randn(2, length + 127 * past, 16, dtype=dtype) for past in (0, 1, 1))
    episode = torch.cat(
        [torch.zeros(2, 127, dtype=torch.int64), (torch.rand(2, length) < 0.01).cumsum(1)], 1
    )
    y, loop = (
        form(query, key, value, episode, 128) for form in (window_attention, window_attention_loop)
    )
    torch.testing.assert_close(y, loop, rtol=0, atol=tolerance * float(loop.abs().max()))


def test_it_is_the_textbook_equation_with_complex_rotations():
    memory = make_memory("attention", 3, 6, window=4).double()
    x, is_init = torch.randn(1, 9, 3, dtype=F64), flags(1, 9, 0, 6)
    y, _ = memory(x, memory.initial_state(1), is_init)
    q, k, v = (layer(x[0]) for layer in (memory.query, memory.key, memory.value))
    speed = 10_000.0 ** (-torch.arange(3, dtype=F64) / 3)
    for t in range(9):
        first = max(6 if t >= 6 else 0, t - 3)
        turned = [torch.polar(torch.ones_like(speed), i * speed) for i in range(t + 1)]
        q_t = torch.view_as_complex(q[t].view(3, 2)) * turned[t]
        scores = [
            (q_t * (torch.view_as_complex(k[j].view(3, 2)) * turned[j]).conj()).sum().real / 6**0.5
            for j in range(first, t + 1)
        ]
        expected = torch.softmax(torch.stack(scores), 0) @ v[first : t + 1]
        torch.testing.assert_close(y[0, t], expected)


@pytest.mark.parametrize("window", [1, 2, 5])
def test_a_step_is_seen_for_exactly_the_window(window):
    memory = make_memory("attention", 3, 4, window=window)
    x = torch.randn(1, 12, 3)
    changed = x.clone()
    changed[:, 4] += 1
    (y, _), (other, _) = (memory(v, memory.initial_state(1), flags(1, 12)) for v in (x, changed))
    differs = (y != other).any(-1)[0]
    assert differs.nonzero().flatten().tolist() == list(range(4, 4 + window))


def test_only_the_distance_of_two_steps_matters():
    q, k = torch.randn(2, 7, dtype=F64)
    products = []
    for shift in (0, 1, 1000, 100_000):
        place = torch.tensor([shift + 5, shift])
        cosine, sine = angles(place, 7, F64)
        products.append(rotate(q, cosine[0], sine[0]) @ rotate(k, cosine[1], sine[1]))
    torch.testing.assert_close(torch.stack(products), products[0].expand(4), rtol=0, atol=1e-9)
    assert (rotate(q, *(a[0] for a in angles(torch.tensor([3]), 7, F64))) @ k - q @ k).abs() > 1e-3


@pytest.mark.parametrize("dtype", [torch.float32, F64, torch.bfloat16])
@pytest.mark.parametrize("width", [1, 2, 7, 8])
def test_pairs_are_turned_in_place_whatever_their_memory_looks_like(width, dtype):
    cosine, sine = angles(torch.arange(5), width, dtype)
    wide = torch.randn(3, 5, 2 * width + 2, dtype=dtype)
    views = [
        torch.randn(3, 5, width, dtype=dtype),
        wide[..., 1 : width + 1],
        wide[..., 2 : width + 2],
        wide[..., ::2],
    ]
    for x in (view[..., :width].requires_grad_() for view in views):
        turned, apart = rotate_pairs(x, cosine, sine), rotate(x, cosine, sine)
        even = width // 2 * 2
        order = [*range(0, even, 2), *range(1, even, 2), *range(even, width)]
        torch.testing.assert_close(turned[..., order], apart)
        weight = torch.randn_like(turned)
        ours = torch.autograd.grad(turned, x, weight)[0]
        torch.testing.assert_close(ours, torch.autograd.grad(apart, x, weight[..., order])[0])


def test_acting_under_vmap_with_flags_that_differ_equals_one_batch():
    memory = make_memory("attention", 3, 4, window=5)
    _, state = memory(torch.randn(6, 9, 3), memory.initial_state(6), flags(6, 9))
    x, is_init = torch.randn(6, 1, 3), torch.arange(6).reshape(6, 1) % 2 == 0

    def act(x, is_init, *leaves):
        rows = TensorDict(
            {n: leaf.unsqueeze(0) for n, leaf in zip(state.keys(), leaves, strict=True)},
            batch_size=[1],
        )
        y, after = memory(x.unsqueeze(0), rows, is_init.unsqueeze(0))
        return y[0], after["key"][0]

    y, after = memory(x, state, is_init)
    mapped = torch.vmap(act)(x, is_init, *state.values())
    for ours, together in zip(mapped, (y, after["key"]), strict=True):
        torch.testing.assert_close(ours, together)


@pytest.mark.parametrize("lengths", [(8,), (1,) * 8, (3, 5), (6, 1, 1)])
def test_the_state_is_a_ring_of_rotated_keys_and_unused_slots_hold_zeros(lengths):
    memory = make_memory("attention", 3, 4, window=5)
    # With three steps of an episode in it, and with more than fit.
    for start, steps in (
        (5, 3),
        (0, 8),
    ):
        x, state, begin = torch.randn(1, 8, 3), memory.initial_state(1), 0
        is_init = flags(1, 8, start)
        for length in lengths:
            _, state = memory(
                x[:, begin : begin + length], state, is_init[:, begin : begin + length]
            )
            begin += length
        assert state["step"].tolist() == [steps]
        for slot in range(5):
            held = [i for i in range(steps) if i % 5 == slot][-1:]
            for name, layer in (("key", memory.key), ("value", memory.value)):
                row = layer(x[:, start + held[0]]) if held else torch.zeros(1, 4)
                if name == "key" and held:
                    row = rotate_pairs(row, *angles(torch.tensor(held), 4, row.dtype))
                torch.testing.assert_close(state[name][:, slot], row)
    assert {
        key: tuple(leaf.shape)
        for key, leaf in make_memory("attention", 512, 512).initial_state(1).items()
    } == {
        "key": (1, 128, 512),
        "value": (1, 128, 512),
        "step": (1,),
    }


def test_long_episodes_stay_exact_when_acted_step_by_step():
    memory = make_memory("attention", 3, 4, window=4)
    x, state, outputs = torch.randn(1, 40, 3), memory.initial_state(1), []
    state["step"].fill_(1_000_000)  # a ring of zeros at a late position: the zeros are attended to
    whole, _ = memory(x, state, flags(1, 40))
    for t in range(40):
        y, state = memory(x[:, t : t + 1], state, flags(1, 1))
        outputs.append(y)
    torch.testing.assert_close(torch.cat(outputs, 1), whole)


def test_an_empty_window_for_every_chunk_is_an_option_and_breaks_the_law_of_several_calls():
    memory = make_memory("attention", 3, 4, window=6, carry_cache=False)
    x = torch.randn(2, 9, 3)
    _, state = memory(x, memory.initial_state(2), flags(2, 9))
    chunk, _ = memory(x, state, flags(2, 9))
    fresh, _ = memory(x, memory.initial_state(2), flags(2, 9))
    assert torch.equal(chunk, fresh)
    acted, _ = memory(x[:, :1], state, flags(2, 1))
    assert (acted - fresh[:, :1]).abs().max() > 1e-3
    with pytest.raises(MemoryLawError, match="step by step"):
        check_memory(memory)


def test_mask_and_weights_stay_small_for_long_sequences():
    memory = make_memory("attention", 4, 4, window=32)
    sizes = []
    with torch.autograd.graph.saved_tensors_hooks(
        lambda x: (sizes.append(x.numel()), x)[1], lambda x: x
    ):
        memory(torch.randn(1, 1000, 4), memory.initial_state(1), flags(1, 1000))
    assert max(sizes) <= 1024 * (32 + 128)


@pytest.mark.parametrize("window", [0, -3])
def test_a_window_without_the_current_step_is_refused(window):
    with pytest.raises(ValueError, match=f"at least 1 step .*got {window}"):
        make_memory("attention", 3, 4, window=window)
