"""check_memory passes lawful modules of anybody's, and names the law that a broken one breaks."""

import warnings
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from arcade_torch.models.checks import MemoryLawError, check_memory, law_results
from arcade_torch.models.mingru import MinGRU
from arcade_torch.models.recurrent_memory import RecurrentMemory
from arcade_torch.models.registry import make_memory, memory_names


class LeakyAverage(nn.Module):
    """A third party's model: two methods, no base class. ``flaw`` switches one mistake on."""

    input_size = 3

    def __init__(self, flaw=None):
        super().__init__()
        self.linear = nn.Linear(3, 4)
        self.flaw = flaw

    def initial_state(self, batch_size):
        state = {"h": self.linear.weight.new_zeros(batch_size, 4)}
        return state if self.flaw == "dictionary" else TensorDict(state, batch_size=[batch_size])

    def forward(self, x, state, is_init):
        flaw, h = self.flaw, state["h"]
        if flaw == "in place":
            h.mul_(0.5)
        if flaw == "ignores state":
            h = torch.zeros_like(h)
        inputs = torch.tanh(self.linear(x))
        if flaw == "batch statistics":
            inputs = inputs - inputs.mean(0)
        if flaw == "looks ahead":
            inputs = inputs + inputs.flip(1)
        outputs = []
        for t in range(x.shape[1]):
            begins = is_init[:, t : t + 1]
            if flaw == "late flag":
                begins = is_init[:, t - 1 : t] if t else torch.zeros_like(begins)
            if flaw == "any row":
                begins = begins.any().expand_as(begins)
            if flaw == "only at index 0" and t:
                begins = torch.zeros_like(begins)
            h = h * (1 - begins.to(h.dtype)) if flaw == "multiplies" else torch.where(begins, 0, h)
            if flaw == "carries a gradient":
                h = torch.where(begins, state["h"] - state["h"].detach(), h)
            if flaw == "leaks":
                h = h + 1e-3 * state["h"]
            previous = h
            h = 0.9 * h + inputs[:, t]
            if flaw == "detach":
                h = 0.9 * previous.detach() + inputs[:, t]
            outputs.append(h)
        y = torch.stack(outputs, 1)
        if flaw == "grows":
            return y, TensorDict({"h": y}, batch_size=[len(x)])
        if flaw == "returns the state before":
            return y, TensorDict({"h": previous}, batch_size=[len(x)])
        if flaw == "float32":
            y = y.float()
        if flaw == "no state":
            return y
        if flaw == "wider":
            self.hidden_size = 3
        return (y.transpose(0, 1) if flaw == "time first" else y), TensorDict(
            {"h": h}, batch_size=[len(x)]
        )


def test_a_third_partys_lawful_module_passes():
    report = check_memory(LeakyAverage())
    assert len(report) == 9 and max(report.values()) < 1e-12


@pytest.mark.parametrize(
    ("flaw", "law", "word"),
    [
        ("in place", "shapes are fixed", "in-place"),
        ("grows", "shapes are fixed", "grows"),
        ("time first", "shapes are fixed", "exchanged"),
        ("float32", "shapes are fixed", "float32"),
        ("wider", "shapes are fixed", "hidden_size is not the width of y"),
        (
            "no state",
            "shapes are fixed",
            "initial_state and forward gave TensorDict, Tensor.* return .y, state.",
        ),
        (
            "dictionary",
            "shapes are fixed",
            "gave dict, Tensor, TensorDict. Likely cause: a state is no TensorDict",
        ),
        ("ignores state", "scan equals step by step", "differ"),
        ("looks ahead", "scan equals step by step", "future"),
        ("late flag", "scan equals step by step", "late"),
        ("only at index 0", "scan equals step by step", "only at index 0"),
        ("returns the state before", "scan equals step by step", "without resets"),
        ("leaks", "scan equals step by step", "differ"),
        ("multiplies", "nothing leaks over a start", "torch.where"),
        ("carries a gradient", "nothing leaks over a start", "gradients flow backward"),
        ("batch statistics", "batch rows are independent", "statistics"),
        ("any row", "batch rows are independent", "flag of one row"),
        ("detach", "gradients are right", "detach"),
    ],
)
def test_a_flaw_is_named_with_the_law_it_breaks(flaw, law, word):
    with pytest.raises(MemoryLawError, match=word) as caught:
        check_memory(LeakyAverage(flaw))
    assert caught.value.law == law
    assert law in str(caught.value) and "Likely cause" in str(caught.value)


def test_a_module_without_a_first_state_is_no_memory():
    with pytest.raises(TypeError, match=r"LSTM has no initial_state\(batch_size\)"):
        check_memory(nn.LSTM(3, 4))


def test_the_size_of_the_discrepancy_is_reported():
    with pytest.raises(MemoryLawError, match="largest difference") as caught:
        check_memory(LeakyAverage("late flag"))
    assert 1e-3 < caught.value.discrepancy < 100


class TreeMinGRU(MinGRU):
    """Combines (state, gate) pairs as a tree, as if the operator were associative; one step at a
    time it is right.
    """

    def run(self, x, h0, is_init):
        gate, candidate = self.gate_and_candidate(x).chunk(2, dim=-1)
        pairs = [(h0, torch.zeros_like(h0), torch.zeros_like(is_init[:, :1]))]
        pairs += zip(
            candidate.tanh().unbind(1),
            gate.sigmoid().unbind(1),
            is_init.unsqueeze(-1).unbind(1),
            strict=True,
        )
        states = [self.combined(pairs[: t + 2])[0] for t in range(x.shape[1])]
        y = torch.stack(states, 1)
        return y, y

    def combined(self, pairs):
        if len(pairs) == 1:
            return pairs[0]
        half = len(pairs) // 2
        (s, _, i), (z, g, j) = self.combined(pairs[:half]), self.combined(pairs[half:])
        return (1 - g) * torch.where(j, 0, s) + g * z, g, i | j


def test_an_operator_that_is_not_associative_is_caught_when_it_is_run_as_a_tree():
    with pytest.raises(MemoryLawError, match="not associative") as caught:
        check_memory(TreeMinGRU(3, 4))
    assert caught.value.law == "scan equals step by step" and caught.value.discrepancy > 1e-3


class ForgetsAt(MinGRU):
    """Loses its state between chunks of 128 steps within a call."""

    def run(self, x, h0, is_init):
        parts = [super(ForgetsAt, self).run(*both) for both in self.chunks(x, h0, is_init)]
        return tuple(torch.cat(part, 1) for part in zip(*parts, strict=True))

    def chunks(self, x, h0, is_init):
        for i, (part, flags) in enumerate(zip(x.split(128, 1), is_init.split(128, 1), strict=True)):
            yield part, h0 if i == 0 else torch.zeros_like(h0), flags


def test_a_state_lost_at_the_border_of_a_chunk_is_caught():
    with pytest.raises(MemoryLawError, match="T=150") as caught:
        check_memory(ForgetsAt(3, 4))
    assert caught.value.law == "scan equals step by step"


class LateReset(nn.Module):
    """Resets one step late, and does so alike in every split, because the flag is part of the
    state.
    """

    input_size = 3

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(3, 4)

    def initial_state(self, batch_size):
        like = self.linear.weight
        return TensorDict(
            {"h": like.new_zeros(batch_size, 4), "flag": like.new_zeros(batch_size, 1)},
            [batch_size],
        )

    def forward(self, x, state, is_init):
        h, late, outputs = state["h"], state["flag"].bool(), []
        for t in range(x.shape[1]):
            h = 0.9 * torch.where(late, 0, h) + self.linear(x[:, t]).tanh()
            late = is_init[:, t : t + 1]
            outputs.append(h)
        state = TensorDict({"h": h, "flag": late.to(h.dtype)}, batch_size=[len(x)])
        return torch.stack(outputs, 1), state


def test_a_reset_that_is_consistently_one_step_late_is_caught():
    with pytest.raises(MemoryLawError, match="start flag does not restore") as caught:
        check_memory(LateReset())
    assert caught.value.law == "packed equals apart"


def test_a_linear_transformer_without_a_running_normaliser_is_caught():
    with pytest.raises(MemoryLawError, match="normaliser that is not accumulated") as caught:
        check_memory(make_memory("linear_transformer", 3, 4, legacy_normaliser=True))
    assert (
        caught.value.law == "an average of equal values is that value"
        and caught.value.discrepancy > 0.1
    )


def test_a_model_that_does_not_claim_to_average_is_not_held_to_it():
    assert "an average of equal values is that value" not in check_memory(make_memory("gdn", 3, 4))
    assert "an average of equal values is that value" in check_memory(
        make_memory("attention", 3, 4)
    )


class ForgetfulReplay(MinGRU):
    """Loads the stored state at index 0 only."""

    def replay(self, x, stored, is_init):
        y, h = self.run(x, stored["h"][:, 0], is_init)
        return y, TensorDict({"h": h}, batch_size=x.shape[:2])


class StaleReplay(MinGRU):
    """Returns the states before each step."""

    def replay(self, x, stored, is_init):
        y, states = super().replay(x, stored, is_init)
        return y, states.apply(lambda h: h.roll(1, 1))


class ReplayOfTheFirst(MinGRU):
    """Loads the state that was stored for index 0 at every start."""

    def replay(self, x, stored, is_init):
        return super().replay(x, stored[:, :1].expand(stored.shape), is_init)


@pytest.mark.parametrize("model", [ForgetfulReplay, ReplayOfTheFirst, StaleReplay])
def test_a_wrong_replay_is_caught(model):
    with pytest.raises(MemoryLawError, match="stored") as caught:
        check_memory(model(3, 4))
    assert caught.value.law == "replay loads stored states"


def test_the_module_itself_is_left_alone():
    memory = LeakyAverage().train()
    weights = memory.linear.weight.clone()
    state = torch.random.get_rng_state()
    check_memory(memory)
    assert memory.training and memory.linear.weight.dtype == torch.float32
    assert torch.equal(memory.linear.weight, weights) and torch.equal(
        torch.random.get_rng_state(), state
    )


class Notes(MinGRU):
    """Notes what it reads."""

    read: ClassVar[list[torch.Tensor]] = []

    def forward(self, x, state, is_init):
        self.read.append(x.detach().clone())
        return super().forward(x, state, is_init)


@pytest.mark.parametrize("check", [check_memory, law_results])
def test_random_inputs_are_those_of_the_seed(check):
    read = []
    for seed in (1, 1, 2):
        Notes.read.clear()
        check(Notes(3, 4), seed=seed)
        read.append(Notes.read[0])
    assert torch.equal(read[0], read[1])
    assert not torch.equal(read[0], read[2])


def test_the_input_size_is_asked_for_when_it_cannot_be_known():
    memory = LeakyAverage()
    memory.input_size = None
    with pytest.raises(ValueError, match="input_size"):
        check_memory(memory)
    check_memory(memory, input_size=3)


# -- less precise numbers ----------------------------------------------------------------------


class OnlyFloat32(LeakyAverage):
    """Stands for a kernel that knows one type."""

    def forward(self, x, state, is_init):
        if x.dtype != torch.float32:
            raise RuntimeError(f"expected float32, got {x.dtype}")
        return super().forward(x, state, is_init)


def test_a_kernel_that_knows_float32_alone_can_be_checked():
    with pytest.raises(RuntimeError, match="expected float32"):
        check_memory(OnlyFloat32())
    report = check_memory(OnlyFloat32(), dtype=torch.float32)
    assert len(report) == 9 and max(report.values()) < 1e-5


@pytest.mark.parametrize("name", memory_names())
def test_our_memories_pass_in_float32(name):
    assert max(check_memory(make_memory(name, 5, 8), dtype=torch.float32).values()) < 1e-5


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("name", ["mingru", "gru", "mlp", "linear_transformer", "attention"])
def test_memories_of_real_numbers_pass_in_half_precision(name, dtype):
    check_memory(make_memory(name, 5, 8), dtype=dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize(
    ("flaw", "law"),
    [
        ("late flag", "scan equals step by step"),
        ("ignores state", "scan equals step by step"),
        ("only at index 0", "scan equals step by step"),
        ("multiplies", "nothing leaks over a start"),
        ("any row", "batch rows are independent"),
        ("looks ahead", "scan equals step by step"),
    ],
)
def test_a_broken_model_is_found_in_less_precise_numbers_too(flaw, law, dtype):
    with pytest.raises(MemoryLawError, match=law):
        check_memory(LeakyAverage(flaw), dtype=dtype)


class WrongGradient(torch.autograd.Function):
    """Passes its input on, and the gradient of the last step alone."""

    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        out = torch.zeros_like(gradient)
        out[:, -1] = gradient[:, -1]
        return out


class Detaching(LeakyAverage):
    def forward(self, x, state, is_init):
        return super().forward(WrongGradient.apply(x), state, is_init)


class DetachingWeight(LeakyAverage):
    """The gradient of a weight alone is that of the last step."""

    def forward(self, x, state, is_init):
        y, after = super().forward(x, state, is_init)
        return y + WrongGradient.apply(self.linear.bias.expand(y.shape)), after


@pytest.mark.parametrize("model", [Detaching, DetachingWeight])
def test_a_wrong_gradient_is_found_in_float32(model):
    with pytest.raises(MemoryLawError, match="gradients"):
        check_memory(model(), dtype=torch.float32)


def test_a_type_that_is_no_floating_one_is_refused():
    with pytest.raises(ValueError, match=r"dtype is torch\.int64, allowed: torch\.float64"):
        check_memory(LeakyAverage(), dtype=torch.int64)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_quantised_module_is_refused_in_one_line(dtype):
    """Before: 'expected scalar type Float but found Double', or rounding as a broken law."""
    memory = RecurrentMemory(nn.GRU(3, 4), 3, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        quantised = torch.ao.quantization.quantize_dynamic(memory, {nn.GRU}, dtype=torch.qint8)
    with pytest.raises(TypeError, match=r"module of RecurrentMemory is quantised.*check it before"):
        check_memory(quantised, dtype=dtype)
    with pytest.raises(TypeError, match="is quantised"):
        law_results(quantised)
