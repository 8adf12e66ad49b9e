"""Networks: published sizes, acting equals learning, options do what they say."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn import functional as F
from torchrl.modules import set_recurrent_mode

from arcade_torch.models import (
    MemoryBlock,
    MemoryNetwork,
    check_memory,
    make_actor_critic,
    make_network,
)
from arcade_torch.models.presets import HEADS, make_head
from tests.models.pixels import count, inputs, run

CELLS = {"lru": 1_050_624, "gru": 1_574_400, "mingru": 525_312, "mlp": 262_656}


@pytest.mark.parametrize("memory", CELLS)
def test_the_papers_network_has_the_published_size(memory):
    assert count(make_network("paper", memory)) == 1_428_613 + 2 * CELLS[memory]


@pytest.mark.parametrize(
    ("memory", "size"), [("mingru", 225_733), ("mlp", 209_221), ("gru", 291_397)]
)
def test_the_small_network_has_the_documented_size(memory, size):
    assert count(make_network("small", memory)) == size


@pytest.mark.parametrize("memory", CELLS)
@pytest.mark.parametrize("skip", ["residual", "none"])
@pytest.mark.parametrize("layers", [1, 2])
def test_the_block_keeps_the_laws_of_a_memory(memory, skip, layers):
    check_memory(MemoryBlock(3, 4, memory, layers=layers, skip=skip), tolerance=1e-6)


@pytest.mark.parametrize("memory", CELLS)
def test_acting_step_by_step_equals_learning_on_the_sequence(memory):
    network = make_network("small", memory)
    pixels, last_action, is_init = inputs(3, 9, 128)
    with torch.no_grad():
        out, last = run(network, pixels, last_action, is_init, network.initial_state(3))
        state, stepped = network.initial_state(3), []
        for t in range(9):
            features = network.encode(network.compress(pixels[:, t])).unsqueeze(1)
            q, state = network.remember(
                features, last_action[:, t : t + 1], is_init[:, t : t + 1], state
            )
            stepped.append(q)
    torch.testing.assert_close(torch.cat(stepped, 1), out, rtol=0, atol=1e-5)
    for key in last.keys(True, True):
        torch.testing.assert_close(state[key], last[key], rtol=0, atol=1e-5)


def test_the_papers_network_acts_as_it_learns():
    network = make_network("paper", "lru")
    pixels, last_action, is_init = inputs(2, 3, 128)
    with torch.no_grad():
        out, _ = run(network, pixels, last_action, is_init, network.initial_state(2))
        state, stepped = network.initial_state(2), []
        for t in range(3):
            q, state = run(
                network,
                pixels[:, t : t + 1],
                last_action[:, t : t + 1],
                is_init[:, t : t + 1],
                state,
            )
            stepped.append(q)
    torch.testing.assert_close(torch.cat(stepped, 1), out, rtol=0, atol=1e-5)


def test_the_residual_skip_lets_the_input_bypass_the_memory_and_none_does_not():
    x, flags = torch.randn(2, 4, 3), torch.zeros(2, 4, dtype=torch.bool)
    for skip in ("residual", "none"):
        block = MemoryBlock(3, 4, "gru", layers=1, skip=skip)
        (
            block.linears[0].weight.data.zero_(),
            block.linears[0].bias.data.zero_(),
        )  # the layer then adds LeakyReLU(0)
        y, _ = block(x, block.initial_state(2), flags)
        expected = block.linear(x) if skip == "residual" else torch.zeros(2, 4, 4)
        torch.testing.assert_close(y, expected)


@pytest.mark.parametrize("skip", ["residual", "none"])
@torch.no_grad()
def test_the_block_is_its_equation_layer_by_layer(skip):
    block = MemoryBlock(3, 4, "gru", layers=2, skip=skip)
    x, is_init = torch.randn(2, 5, 3), torch.rand(2, 5) < 0.3
    state = block.initial_state([2])
    y, after = block(x, state, is_init)
    expected = block.linear(x)
    for name, cell, linear in zip(block.names, block.cells, block.linears, strict=True):
        read, state_after = cell(expected, state[name], is_init)
        added = F.leaky_relu(F.layer_norm(linear(read), (4,)))
        expected = expected + added if skip == "residual" else added
        assert torch.equal(after[name, "h"], state_after["h"])
    torch.testing.assert_close(y, expected)
    stored = torch.stack([state] * 5, dim=1)
    assert block.replay(x, stored, is_init)[1].batch_size == (2, 5)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"input_size": 2.5}, "^input_size must be a whole number from 1, got 2.5$"),
        ({"hidden_size": 0}, "^hidden_size must be a whole number from 1, got 0$"),
        ({"layers": 0}, "^layers must be at least 1, got 0$"),
    ],
)
def test_sizes_of_a_block_are_whole_numbers_from_one(sizes, message):
    with pytest.raises(ValueError, match=message):
        MemoryBlock(**{"input_size": 3, "hidden_size": 4, "memory": "gru"} | sizes)


def last_action_matters(network, is_init):
    """Does the output at step 0 depend on the last action shown there?"""
    pixels, last_action, _ = inputs(1, 1)
    state = network.initial_state(1)
    with torch.no_grad():
        first, _ = run(network, pixels, last_action, torch.tensor([[is_init]]), state)
        other, _ = run(network, pixels, (last_action + 1) % 5, torch.tensor([[is_init]]), state)
    return not torch.equal(first, other)


def test_the_last_action_is_seen_and_zeroed_at_a_start_only_where_asked():
    small = {"preset": "small", "memory": "gru"}
    assert last_action_matters(make_network(**small), is_init=False)
    assert not last_action_matters(make_network(**small), is_init=True)
    assert last_action_matters(make_network(**small, zero_action_on_reset=False), is_init=True)
    assert not last_action_matters(make_network(**small, use_last_action=False), is_init=False)
    assert not make_network("paper", "mlp").zero_action_on_reset


def predicting(memory, **options):
    torch.manual_seed(0)
    return make_network("small", memory, obs_size=32, **options)


@pytest.mark.parametrize("memory", ["lru", "feedforward"])
def test_the_error_of_prediction_is_the_one_written_out_and_changes_nothing_else(memory):
    network = predicting(memory, predicts=True)
    pixels, last_action, is_init = inputs(3, 6)
    batch = TensorDict(
        {"pixels": pixels, "last_action": last_action, "is_init": is_init.unsqueeze(-1)}, [3, 6]
    )
    with torch.no_grad(), set_recurrent_mode(True):
        found, plain = network(batch.clone()), predicting(memory)(batch.clone())
    assert "prediction_error" not in plain
    assert torch.equal(found["action_value"], plain["action_value"])
    with torch.no_grad():
        features = network.encode(pixels)
        one_hot = F.one_hot(last_action, 5).float()
        seen = (
            torch.cat([features, one_hot * ~is_init.unsqueeze(-1)], -1)
            if memory == "lru"
            else features
        )
        y, _ = network.block(seen, network.initial_state(3), is_init)
        nexts = features[:, 1:].reshape(-1, 128)
        mean, deviation = nexts.mean(0), nexts.var(0, correction=0).sqrt()
        for b in range(3):
            for t in range(6):
                wanted = torch.zeros(())
                if t < 5 and not is_init[b, t + 1]:
                    known = torch.cat([y[b, t], one_hot[b, t + 1]]) if memory == "lru" else y[b, t]
                    target = (features[b, t + 1] - mean) / (deviation + 0.01)
                    wanted = ((network.predictor(known) - target) ** 2).mean()
                torch.testing.assert_close(found["prediction_error"][b, t, 0], wanted)


def test_the_frame_that_is_predicted_gets_no_gradient_and_those_before_it_do():
    network = predicting("lru", predicts=True)
    pixels, last_action, _ = inputs(1, 5)
    frames, flags = pixels.float().requires_grad_(), torch.zeros(1, 5, 1, dtype=torch.bool)
    batch = TensorDict({"pixels": frames, "last_action": last_action, "is_init": flags}, [1, 5])
    with set_recurrent_mode(True):
        network(batch)["prediction_error"][0, 3].backward()
    reached = frames.grad[0].flatten(1).abs().sum(1)
    assert reached[4] == 0 and (reached[:4] > 0).all()


def test_padding_is_never_predicted_and_no_part_of_the_batchs_deviation():
    """``split_trajectories`` fills rows up, with zeros that begin no episode."""
    network = predicting("lru", predicts=True)
    pixels, last_action, is_init = inputs(3, 6)
    is_init[:, 4:] = False
    entries = {"pixels": pixels, "last_action": last_action, "is_init": is_init.unsqueeze(-1)}
    batch = TensorDict(entries, [3, 6])
    mask = torch.arange(6) < torch.tensor([[4], [4], [4]])
    with torch.no_grad(), set_recurrent_mode(True):
        wanted = F.pad(network(batch[:, :4].clone())["prediction_error"], (0, 0, 0, 2))
        for key in ("mask", ("collector", "mask")):
            found = network(batch.clone().set(key, mask))["prediction_error"]
            torch.testing.assert_close(found, wanted)


def test_a_batch_of_single_steps_and_padding_has_nothing_to_predict():
    network = predicting("lru", predicts=True)
    pixels, last_action, _ = inputs(2, 3)
    flags, mask = torch.zeros(2, 3, 1, dtype=torch.bool), torch.zeros(2, 3, dtype=torch.bool)
    mask[:, 0] = True
    entries = {"pixels": pixels, "last_action": last_action, "is_init": flags, "mask": mask}
    with set_recurrent_mode(True):
        error = network(TensorDict(entries, [2, 3]))["prediction_error"]
    error.mean().backward()
    assert not error.any()
    assert not any(p.grad.any() for p in network.parameters() if p.grad is not None)


def test_a_step_predicts_nothing_and_of_two_towers_the_actor_does():
    network = predicting("lru", predicts=True)
    flags, frame = torch.ones(2, 1, dtype=torch.bool), torch.zeros(2, 32, 32, 3, dtype=torch.uint8)
    step = {"pixels": frame, "last_action": torch.zeros(2, dtype=torch.int64), "is_init": flags}
    assert "prediction_error" not in network(TensorDict(step, [2]))
    two = make_actor_critic("small", "lru", towers=2, predicts=True, obs_size=32)
    assert two.actor.predictor is not None and two.critic.predictor is None


def test_saliency_reaches_every_earlier_frame_through_the_memory():
    network = make_network("small", "mingru")
    pixels, last_action, is_init = inputs(1, 4, 128)
    smooth = pixels.float().requires_grad_()
    q, _ = run(network, smooth, last_action, torch.zeros_like(is_init), network.initial_state(1))
    q[0, -1].max().backward()
    assert (smooth.grad.abs().sum((0, 2, 3, 4)) > 0).all()
    smooth.grad = None
    is_init[:] = torch.tensor([[True, False, True, False]])
    q, _ = run(network, smooth, last_action, is_init, network.initial_state(1))
    q[0, -1].max().backward()
    assert (smooth.grad.abs().sum((0, 2, 3, 4)) > 0).tolist() == [False, False, True, True]


def test_the_state_is_nested_by_layer_and_zero_at_first():
    state = make_network("paper", "lru").initial_state(3)
    assert isinstance(state, TensorDict) and state.batch_size == (3,)
    assert {key: tuple(state[key].shape) for key in state.keys(True, True)} == {
        ("layer0", "h"): (3, 512, 2),
        ("layer1", "h"): (3, 512, 2),
    }
    assert all((state[key] == 0).all() for key in state.keys(True, True))
    assert make_network("small", "mlp").initial_state(3).is_empty()


def test_small_starts_with_small_values_and_slow_gates():
    network = make_network("small", "mingru")
    assert network.head.bias.eq(0).all() and network.head.weight.abs().max() <= 0.1 / 128**0.5
    bias = network.block.cells[0].gate_and_candidate.bias[:128]
    assert bias.min() < -4 and bias.max() <= 0
    fast = make_network("small", "mingru", memory_options={"slow_gates": False}).block.cells[0]
    assert fast.gate_and_candidate.bias.min() > -1


def test_sizes_heads_and_outputs_are_options():
    network = make_network(
        "paper", "mingru", layers=8, hidden_size=128, head="paper", num_outputs=1
    )
    assert len(network.block.cells) == 8 and network.block.hidden_size == 128
    assert count(network.head) == (128 * 256 + 256) + (256 * 256 + 256) + 512 + 257
    for name in HEADS:
        assert make_head(name, 16, 3)(torch.zeros(2, 5, 16)).shape == (2, 5, 3)


def test_a_memory_of_ones_own_can_be_a_factory():
    from arcade_torch.models import make_memory

    made = []

    def factory(input_size, hidden_size, **options):
        made.append((input_size, hidden_size, options))
        return make_memory("gru", input_size, hidden_size)

    make_network("small", factory, memory_options={"depth": 3})
    assert made == [(128, 128, {"depth": 3})]


class OfOtherOutputs(nn.Module):
    """A memory that gives something else than float32 [B, T, H]."""

    def __init__(self, dtype, width):
        super().__init__()
        self.linear = nn.Linear(8, width, dtype=dtype)

    def initial_state(self, batch_size):
        return TensorDict({"h": torch.zeros(batch_size, 1)}, [batch_size])

    def forward(self, x, state, is_init):
        return self.linear(x.to(self.linear.weight.dtype)), state


@pytest.mark.parametrize(
    ("dtype", "width", "said"),
    [
        (torch.bfloat16, 8, r"y torch.bfloat16 \[2, 3, 8\] for x torch.float32 \[2, 3, 8\]"),
        (torch.float32, 5, r"y torch.float32 \[2, 3, 5\] for x torch.float32 \[2, 3, 8\]"),
    ],
)
def test_a_memory_of_other_outputs_is_told_in_one_line(dtype, width, said):
    """Before: 'mat1 and mat2 must have the same dtype', told as a fault of ours by train."""
    block = MemoryBlock(4, 8, lambda input_size, hidden_size: OfOtherOutputs(dtype, width))
    x, is_init = torch.zeros(2, 3, 4), torch.zeros(2, 3, dtype=torch.bool)
    with pytest.raises(ValueError, match=f"OfOtherOutputs gives {said}"):
        block(x, block.initial_state(2), is_init)


@pytest.mark.parametrize("make", [make_network, make_actor_critic])
def test_a_memory_that_is_made_already_is_no_factory(make):
    """``TypeError: cannot unpack non-iterable int object``, from inside of it."""
    from arcade_torch.models import make_memory

    with pytest.raises(
        TypeError, match=r"lambda input_size, hidden_size.*got the GRU that is made"
    ) as info:
        make("small", make_memory("gru", 128, 128))
    assert "\n" not in str(info.value)
    with pytest.raises(TypeError, match=r"a name, such as 'lru', or a factory .* got 3"):
        make("small", 3)


def test_calibration_goes_through_the_network_and_is_saved_with_it():
    pixels = inputs(4, 3, 128)[0]
    network, twin = make_network("small", "mlp"), make_network("small", "mlp")
    network.calibrate(network.compress(pixels))
    assert (network.encoder.mean != 0).any()
    twin.load_state_dict(network.state_dict())
    assert torch.equal(twin.encode(pixels), network.encode(pixels))
    make_network("paper", "mlp").calibrate(pixels)  # nothing to do, but allowed


@pytest.mark.parametrize("make", [make_network, make_actor_critic])
def test_a_network_without_data_is_whole_when_its_weights_are_loaded(make):
    network = make("small", "gru", hidden_size=16)
    with torch.device("meta"):
        loaded = make("small", "gru", hidden_size=16)
    loaded.to_empty(device="cpu").load_state_dict(network.state_dict())
    data = TensorDict(
        {
            "pixels": torch.randint(256, (2, 128, 128, 3), dtype=torch.uint8),
            "last_action": torch.tensor([1, 4]),
            "is_init": torch.zeros(2, 1, dtype=torch.bool),
        },
        batch_size=[2],
    )
    data["memory"] = network.initial_state(2)
    reads = [one(data.clone()) for one in (network, loaded)]
    for key, value in reads[0].items(True, True):
        assert torch.equal(reads[1][key], value), key


def test_a_network_made_in_inference_mode_is_moved_outside_of_it():
    with torch.inference_mode():
        network = make_network("small", "gru", hidden_size=16)
    assert next(network.to(torch.float64).parameters()).dtype == torch.float64


def test_dtype_follows_the_parameters():
    network = make_network("small", "lru").double()
    pixels, last_action, is_init = inputs()
    out, state = run(network, pixels, last_action, is_init, network.initial_state(2))
    assert out.dtype == torch.float64 and state["layer0", "h"].dtype == torch.float64


@torch.no_grad()
def test_sequences_need_neither_a_last_action_nor_a_state_that_nobody_reads():
    network = make_network("small", "mlp", obs_size=32, use_last_action=False)
    pixels, _, is_init = inputs(2, 4)
    sequences = TensorDict({"pixels": pixels, "is_init": is_init.unsqueeze(-1)}, [2])
    read = network.read_sequences(sequences, TensorDict({}, [2]))
    with set_recurrent_mode(True):
        written = network(sequences.auto_batch_size_(2))
    torch.testing.assert_close(read["action_value"], written["action_value"])


@torch.no_grad()
def test_under_autocast_the_memory_reads_in_single_precision():
    network = make_network("small", "gru", obs_size=32)
    pixels, last_action, is_init = inputs(2, 4)
    first = network.initial_state(2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        features = network.encode(pixels).bfloat16()
        _, state = network.remember(features, last_action, is_init, first)
    _, expected = network.remember(features.float(), last_action, is_init, first)
    assert (state == expected).all()


def test_the_last_action_is_not_hidden_at_cuts():
    block = MemoryBlock(8, 4, "gru")
    with pytest.raises(ValueError, match=r"^zero_action_on_reset needs store='sequence'"):
        MemoryNetwork(nn.Identity(), block, nn.Identity(), zero_action_on_reset=True, store="step")


@pytest.mark.parametrize("memory", ["mingru", "lru"])
def test_a_network_runs_under_one_compiled_graph(memory):
    network = make_network("small", memory)
    pixels, last_action, is_init = inputs(2, 4)
    features, state = network.encode(pixels).detach(), network.initial_state(2)

    def loss(features, last_action, is_init):
        return network.remember(features, last_action, is_init, state)[0].square().mean()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(
        compiled(features, last_action, is_init), loss(features, last_action, is_init)
    )
    weights = [p for p in network.parameters() if isinstance(p, nn.Parameter)]
    ours = torch.autograd.grad(compiled(features, last_action, is_init), weights, allow_unused=True)
    eager = torch.autograd.grad(loss(features, last_action, is_init), weights, allow_unused=True)
    for p, q in zip(ours, eager, strict=True):
        if q is not None:
            torch.testing.assert_close(p, q)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "smal"}, "mean 'small'"),
        ({"memory": "lur"}, "mean 'lru'"),
        ({"head": "big"}, "one of reference, paper, .*linear.*got 'big'"),
        ({"skip": "dense"}, "residual"),
        ({"memory": "feedforward", "head": "big"}, "one of reference, paper, .*linear.*got 'big'"),
        ({"memory": "feedforward", "skip": "dense"}, "residual"),
        (
            {"memory": "feedforward", "actor_critic_head": "big"},
            "actor_critic_head must be one of .*got 'big'",
        ),
        ({"layers": 0}, "at least 1"),
        ({"obs_size": 100}, "128 and 256"),
    ],
)
def test_wrong_options_get_one_clear_line(options, message):
    with pytest.raises(ValueError, match=message):
        make_network(**{"preset": "paper", "memory": "lru"} | options)


def test_an_unknown_option_is_refused_by_name():
    with pytest.raises(TypeError, match=r"width.*allowed are encoder, hidden_size"):
        make_network("small", "gru", width=3)


def test_options_of_cells_are_refused_where_there_is_no_memory():
    with pytest.raises(TypeError, match=r"'feedforward' has no memory, .* got \{'foo': 1\}$"):
        make_network("small", "feedforward", memory_options={"foo": 1})


@pytest.mark.parametrize("name", ["hidden_size", "layers", "feedforward_size"])
def test_a_size_that_is_no_number_gets_one_line(name):
    with pytest.raises(ValueError, match=rf"^{name} must be a whole number, got 'abc'$"):
        make_network("small", "gru", **{name: "abc"})
