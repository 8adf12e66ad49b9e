"""Arguments of memory models and networks that are of another type or range than their docstrings
allow: one line, and never a model that is something else in silence.
"""

import math

import numpy as np
import pytest
import torch

from arcade_torch.models import (
    ActorCriticNetwork,
    MatrixSteps,
    MemoryBlock,
    MemoryModule,
    PaperEncoder,
    SmallEncoder,
    check_memory,
    law_results,
    linear_scan,
    make_actor_critic,
    make_memory,
    make_network,
    matrix_scan,
    matrix_scan_loop,
    memory_names,
)

NAMES = memory_names()
NO_SIZES = (4.0, True, "4", None, math.nan)

OPTIONS = [
    ("attention", "window"),
    ("gtrxl", "window"),
    ("frame_stack", "frames"),
    ("ffm", "trace_size"),
    ("ffm", "context_size"),
    ("shm", "key_size"),
    ("shm", "rows"),
    ("gdn", "key_size"),
    ("ttt", "key_size"),
    ("linear_transformer", "key_size"),
    ("deltaproduct", "key_size"),
    ("deltaproduct", "householders"),
    ("rwkv7", "key_size"),
    ("mlstm", "key_size"),
    ("s5", "state_size"),
    ("mamba", "state_size"),
    ("mamba", "expand"),
    ("mamba", "conv"),
]

FLAGS = [
    ("attention", "carry_cache"),
    ("mingru", "slow_gates"),
    ("gdn", "gate_alpha"),
    ("gdn", "legacy_left"),
    ("deltaproduct", "gate_alpha"),
    ("linear_transformer", "legacy_normaliser"),
]

NUMBERS = [
    ("lru", "r_min", "a"),
    ("lru", "max_phase", math.nan),
    ("lru", "max_phase", -1.0),
    ("lru", "max_phase", math.inf),
    ("rtu", "max_phase", math.nan),
    ("gtrxl", "gate_bias", math.nan),
    ("gtrxl", "gate_bias", "2"),
    ("gdn", "beta_range", "2"),
    ("gdn", "beta_range", True),
    ("s5", "dt_max", math.inf),
    ("bmru", "slope", "8"),
]


def one_line(message, call, *args, kind=ValueError, **options):
    """A call is refused by one line that matches."""
    with pytest.raises(kind, match=message) as refused:
        call(*args, **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("wrong", NO_SIZES)
@pytest.mark.parametrize("name", NAMES)
def test_a_size_that_is_no_whole_number_is_refused(name, wrong):
    one_line("^input_size must be a whole number, got", make_memory, name, wrong, 4)
    one_line("^hidden_size must be a whole number, got", make_memory, name, 4, wrong)


@pytest.mark.parametrize(("name", "option"), OPTIONS)
def test_an_option_that_counts_is_a_whole_number(name, option):
    for wrong in (4.0, True, "4", math.nan):
        one_line(f"^{option} must be a whole number", make_memory, name, 8, 8, **{option: wrong})


@pytest.mark.parametrize(("name", "option"), FLAGS)
def test_a_switch_is_true_or_false(name, option):
    for wrong in ("no", 1, None):
        one_line(f"^{option} must be True or False", make_memory, name, 8, 8, **{option: wrong})


@pytest.mark.parametrize(("name", "option", "wrong"), NUMBERS)
def test_a_number_is_finite_and_in_its_range(name, option, wrong):
    one_line(option, make_memory, name, 8, 8, **{option: wrong})


@pytest.mark.parametrize("name", NAMES)
def test_sizes_may_be_numbers_of_numpy(name):
    memory = make_memory(name, np.int64(3), np.int32(4))
    flags = torch.zeros(2, 5, dtype=torch.bool)
    y, _ = memory(torch.zeros(2, 5, 3), memory.initial_state(np.int64(2)), flags)
    assert y.shape == (2, 5, 4)


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_size_is_one_whole_number_or_several(name):
    memory = make_memory(name, 3, 4)
    for wrong in (2.5, True, None, "2", -1, [2, -1], [2, 2.5], math.nan):
        one_line("^batch_size must be", memory.initial_state, wrong)
    assert memory.initial_state(()).batch_size == ()
    assert memory.initial_state([2, 3]).batch_size == (2, 3)
    assert memory.initial_state(0).batch_size == (0,)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "mlp"])
def test_a_state_of_another_dtype_than_the_memorys_is_refused(name):
    memory = make_memory(name, 3, 4)
    flags = torch.zeros(2, 5, dtype=torch.bool)
    x = torch.zeros(2, 5, 3)
    for dtype in (torch.float64, torch.int16):
        state = memory.initial_state(2).apply(lambda leaf, dtype=dtype: leaf.to(dtype))
        one_line("of the state must be", memory, x, state, flags)


def test_an_input_that_is_no_tensor_is_refused():
    memory = make_memory("gru", 3, 4)
    flags = torch.zeros(2, 5, dtype=torch.bool)
    for wrong in (None, [[1.0]], np.zeros((2, 5, 3), np.float32)):
        one_line(r"^x must be a tensor \[B, T, 3\]", memory, wrong, memory.initial_state(2), flags)


@pytest.mark.parametrize("check", [check_memory, law_results])
def test_the_check_of_a_memory_does_not_blame_it_for_arguments_of_the_call(check):
    memory = make_memory("gru", 3, 4)
    for wrong in (0, -1, True, "3", 3.0):
        one_line("^input_size must be", check, memory, input_size=wrong)
    for wrong in (1.5, None, "a", True, 2**70):
        one_line("^seed must be", check, memory, seed=wrong)
    for wrong in (type(memory), None, "gru"):
        one_line("must be an nn.Module", check, wrong, kind=TypeError)


def test_a_tolerance_that_nothing_can_meet_is_refused():
    memory = make_memory("gru", 3, 4)
    for wrong in (-1.0, math.nan, math.inf, "a", True):
        one_line("^tolerance must be", check_memory, memory, tolerance=wrong)
    one_line("^gradients must be True or False", check_memory, memory, gradients="no")


def test_the_linear_scan_loses_no_imaginary_part_and_takes_tensors():
    a = torch.full((2, 5, 3), 0.5)
    one_line("^a and b must be floats, complex or whole", linear_scan, a.bool(), a.bool())
    state = torch.ones(2, 3, dtype=torch.complex64)
    one_line("^h0 is complex, and a and b are not", linear_scan, a, a, None, state)
    one_line("^a must be a tensor, got a float", linear_scan, 0.5, a)
    one_line("^b must be a tensor, got a ndarray", linear_scan, a, a.numpy())
    one_line("^start must be a tensor or None", linear_scan, a, a, [[False] * 5] * 2)
    one_line("^h0 must be a tensor or None", linear_scan, a, a, None, 0.0)


def test_the_states_of_a_scan_are_never_the_memory_of_its_inputs():
    a = torch.full((2, 1, 3), 0.5)
    b = torch.ones(2, 1, 3)
    linear_scan(a, b).add_(1)
    assert (b == 1).all()


@pytest.mark.parametrize("steps", [5, 1])
@pytest.mark.parametrize("scan", [matrix_scan, matrix_scan_loop])
def test_the_matrix_scan_refuses_shapes_that_do_not_fit(scan, steps):
    def tensors(**given):
        sizes = {"query": 3, "key": 3, "value": 4, "erase": 1, "log_decay": 1}
        drawn = {name: -torch.rand(2, steps, size) for name, size in sizes.items()}
        return MatrixSteps(**(drawn | given))

    start = torch.zeros(2, steps, dtype=torch.bool)
    h0 = torch.zeros(2, 3, 4)
    scan(tensors(), start, h0)
    for wrong in (start.float(), start[..., None], start.long(), None):
        one_line(rf"^start must be bool \[2, {steps}\]", scan, tensors(), wrong, h0)
    for wrong in (h0.mT, h0[0], torch.zeros(2, steps + 1, 3, 4), None):
        one_line("^h0 must be", scan, tensors(), start, wrong)
    one_line("^h0 is torch.float64", scan, tensors(), start, h0.double())
    one_line("^key must be", scan, tensors(key=torch.zeros(2, steps, 4)), start, h0)
    one_line("^value must be", scan, tensors(value=torch.zeros(2, steps + 1, 4)), start, h0)
    one_line("^erase must be", scan, tensors(erase=torch.zeros(2, steps)), start, h0)
    one_line("^log_decay must be", scan, tensors(log_decay=torch.zeros(2, steps, 3)), start, h0)
    one_line(
        "^value is torch.float64", scan, tensors(value=torch.zeros(2, steps, 4).double()), start, h0
    )
    none = MatrixSteps(*(torch.zeros(2, 0, size) for size in (3, 3, 4)))
    one_line("at least one step", scan, none, start[:, :0], h0)


def test_other_arguments_of_the_matrix_scan_are_checked():
    steps = MatrixSteps(*(torch.zeros(2, 5, size) for size in (3, 3, 4)))
    start = torch.zeros(2, 5, dtype=torch.bool)
    h0 = torch.zeros(2, 3, 4)
    for wrong in (0, -1, 2.5, True, None):
        one_line("^chunk must be", matrix_scan, steps, start, h0, chunk=wrong)
    one_line("erase_values needs K = V", matrix_scan_loop, steps, start, h0, erase_values=True)


@pytest.mark.parametrize("make", [SmallEncoder, PaperEncoder])
def test_an_encoder_compresses_frames_and_nothing_else(make):
    encoder = make(128)
    frames = torch.randint(0, 256, (2, 3, 128, 128, 3), dtype=torch.uint8)
    turned = frames.movedim(-1, -3)
    for wrong in (turned, frames[..., :64, :64, :], frames[0, 0, ..., 0], frames[..., :120, :]):
        one_line(r"^frames must be \[\.\.\., 128, 128, 3\]", encoder.compress, wrong)
    for method in (encoder, encoder.compress):
        for dtype in (torch.int8, torch.bool, torch.int64):
            one_line("^frames must be uint8 or floats", method, frames.to(dtype))
        one_line("^frames must be a tensor", method, frames.numpy())
    assert encoder.compress(encoder.compress(frames)).shape == (2, 3, *encoder.stored_shape)


def test_a_small_encoder_is_not_calibrated_by_what_is_no_number():
    encoder = SmallEncoder(128)
    frames = torch.full((2, 128, 128, 3), math.nan)
    one_line("^frames must be finite", encoder.calibrate, frames)
    assert encoder.mean.isfinite().all()


@pytest.mark.parametrize("wrong", [0, -1, 2.5, True])
def test_the_sizes_of_an_encoder_are_whole_numbers(wrong):
    one_line("^channels must be a whole number", SmallEncoder, channels=wrong)
    one_line("obs_size", SmallEncoder, float(128))
    one_line("obs_size", PaperEncoder, float(128))


@pytest.mark.parametrize("make", [make_network, make_actor_critic])
def test_the_arguments_of_a_network_are_checked(make):
    for wrong in (-1, 2.5, True, None):
        one_line("^num_actions must be a whole number", make, "small", num_actions=wrong)
    for wrong in (3, "lru", [("r_min", 0.1)]):
        one_line("^memory_options must be a mapping", make, "small", memory_options=wrong)
    for wrong in (None, 3):
        one_line("^memory has to be a name", make, "small", wrong, kind=TypeError)
    one_line("^encoder must be a function of obs_size", make, "small", encoder="cnn")


def test_the_outputs_of_a_network_are_whole_numbers_and_have_keys_of_their_own():
    for wrong in (0, -1, 2.5, True, math.nan):
        one_line(
            "^num_outputs must be a whole number from 1", make_network, "small", num_outputs=wrong
        )
    one_line("^out_key and value_key are both", make_network, "small", value_key="action_value")
    for name in ("out_key", "state_key"):
        one_line(f"^{name} must be a string", make_network, "small", **{name: 3})


def test_an_actor_critic_drops_no_option_in_silence():
    for name in ("num_outputs", "out_key", "value_key", "state_key"):
        one_line(
            f"^unknown network option {name}",
            make_actor_critic,
            "small",
            kind=TypeError,
            **{name: "x"},
        )
    heads = {"head": "paper", "actor_critic_head": "linear"}
    one_line("^head and actor_critic_head", make_actor_critic, "small", **heads)
    one_line(
        "^num_actions must be a whole number from 1", make_actor_critic, "small", num_actions=0
    )


def test_actor_and_critic_fit_together():
    actor = make_network("small", out_key="logits", state_key="actor")
    critic = {"out_key": "state_value", "num_outputs": 1}
    same_key = make_network("small", state_key="actor", **critic)
    one_line("state keys of actor and critic", ActorCriticNetwork, actor, same_key)
    other_size = make_network("small", state_key="critic", obs_size=64, **critic)
    one_line("frames of 128 and of 64 pixels", ActorCriticNetwork, actor, other_size)
    fits = make_network("small", state_key="critic", **critic)
    one_line(
        "the actor must write logits, and the critic state_value", ActorCriticNetwork, fits, actor
    )
    ActorCriticNetwork(actor, fits)


def test_the_arguments_of_a_memory_block_are_checked():
    for wrong in (0, 2.5, True, "4"):
        one_line("^input_size must be a whole number from 1", MemoryBlock, wrong, 4)
        one_line("^hidden_size must be a whole number from 1", MemoryBlock, 4, wrong)
    for wrong in (1.5, True, "2"):
        one_line("^layers must be a whole number", MemoryBlock, 4, 4, layers=wrong)
    one_line("^memory has to be a name", MemoryBlock, 4, 4, None, kind=TypeError)


@pytest.mark.parametrize("steps", [2, 3])
def test_last_actions_and_start_flags_have_a_number_a_step(steps):
    network = make_network("small", "gru")
    features = torch.zeros(2, steps, network.encoder.feature_size)
    last_action = torch.zeros(2, steps, dtype=torch.int64)
    flags = torch.zeros(2, steps, dtype=torch.bool)
    state = network.initial_state(2)
    one_hot = torch.zeros(2, steps, 5)
    for wrong in (last_action[..., None], one_hot, last_action[0], last_action[:, :1], None):
        one_line(
            rf"^last_action must be whole numbers \[2, {steps}\]",
            network.remember, features, wrong, flags, state,
        )  # fmt: skip
    one_line(
        "^last_action must be whole", network.remember, features, last_action + 0.5, flags, state
    )
    for wrong in (flags[..., None], flags[0], flags[:, :1]):
        one_line(
            rf"^is_init must be bool \[2, {steps}\]",
            network.remember,
            features,
            last_action,
            wrong,
            state,
        )


def test_the_keys_and_switches_of_a_memory_module_are_checked():
    memory = make_memory("gru", 3, 4)
    for name in ("in_key", "out_key", "state_key", "is_init_key"):
        for wrong in (3, None, (), ("a", 3)):
            one_line(f"^{name} must be a string or a tuple", MemoryModule, memory, **{name: wrong})
    for name in ("default_recurrent_mode", "check_sequences"):
        one_line(f"^{name} must be True or False", MemoryModule, memory, **{name: "no"})
