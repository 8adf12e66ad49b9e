"""``RecurrentMemory``: modules of other libraries, of every layout that is about, keep the laws."""

import copy
from collections import OrderedDict
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import GRU as TorchRLGRU
from torchrl.modules import LSTM as TorchRLLSTM
from torchrl.modules import set_recurrent_mode

from arcade_torch import ArcadeCollector, make
from arcade_torch.agents import PQNLoss, make_policy
from arcade_torch.models import (
    MemoryLawError,
    MemoryModule,
    RecurrentMemory,
    check_memory,
    make_network,
    register_memory,
    registry,
)
from tests.models.zoo import assert_each_episode

D = 3
H = 4


class Two(NamedTuple):
    slow: Tensor
    fast: Tensor


class ManyLeaves(nn.Module):
    """A state of all containers at once, with a batch axis in every place and a count of steps."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(D, H)

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        if state is None:
            zeros = x.new_zeros(len(x), H)
            count = torch.zeros(len(x), dtype=torch.int64)
            state = {"two": Two(zeros.T, zeros), "list": [zeros[None], (count,)]}
        slow = state["two"].slow.T
        fast = state["two"].fast
        layer, (count,) = state["list"]
        layer = layer[0]
        outputs = []
        for inputs in self.linear(x).unbind(1):
            count = count + 1
            slow = 0.9 * slow + inputs
            fast = 0.5 * fast + slow
            layer = torch.tanh(layer + fast)
            outputs.append(layer + 1 / count.to(x.dtype)[:, None])
        after = {"two": Two(slow.T, fast), "list": [layer[None], (count,)]}
        return torch.stack(outputs, 1), after


class LearnedStart(nn.Module):
    """Begins with a parameter, and takes nothing else but steps and a state."""

    def __init__(self) -> None:
        super().__init__()
        self.begins_with = nn.Parameter(torch.ones(H))
        self.linear = nn.Linear(D, H)

    def step(self, x: Tensor, h: Tensor) -> Tensor:
        return torch.tanh(0.9 * h + self.linear(x))


def run_steps(module: Any, x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    outputs = []
    for step in x.unbind(1):
        h = module.step(step, h)
        outputs.append(h)
    return torch.stack(outputs, 1), h


def start_learned(module: Any, batch_size: int) -> Tensor:
    return module.begins_with.expand(batch_size, H)  # type: ignore[no-any-return]


def learned_start() -> RecurrentMemory:
    return RecurrentMemory(LearnedStart(), D, H, run=run_steps, start=start_learned)


class Carries(nn.Module):
    """A GRU whose state is put into a container."""

    def __init__(self, put: Any, take: Any) -> None:
        super().__init__()
        self.gru = nn.GRU(D, H, batch_first=True)
        self.put = put
        self.take = take

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        y, h = self.gru(x, None if state is None else self.take(state)[None])
        return y, self.put(h[0])


def in_order(state: Any) -> Tensor:
    """The tensor of an OrderedDict."""
    state.move_to_end("h")
    return state["h"]  # type: ignore[no-any-return]


def in_batch(state: Any) -> Tensor:
    """The tensor of a TensorDict [B], from one inside of it."""
    assert state.batch_size == state["deep"].batch_size == state["deep", "h"].shape[:1]
    return state["deep", "h"]  # type: ignore[no-any-return]


def ordered() -> nn.Module:
    return Carries(lambda h: OrderedDict(h=h), in_order)


def in_tensordict() -> nn.Module:
    return Carries(lambda h: TensorDict({"deep": {"h": h}}, batch_size=[len(h)]), in_batch)


def with_nothing() -> nn.Module:
    return Carries(lambda h: (None, [h, ()]), lambda state: state[1][0])


MODULES = {
    "RNN": lambda: nn.RNN(D, H, batch_first=True),
    "GRU, time first": lambda: nn.GRU(D, H),
    "LSTM of two layers": lambda: nn.LSTM(D, H, num_layers=2),
    "LSTM with a projection": lambda: nn.LSTM(D, 6, proj_size=H, batch_first=True),
    "LSTM of TorchRL": lambda: TorchRLLSTM(D, H, batch_first=True),
    "GRU of TorchRL": lambda: TorchRLGRU(D, H),
    "all containers": ManyLeaves,
    "OrderedDict": ordered,
    "TensorDict": in_tensordict,
    "None beside a tensor": with_nothing,
}


@pytest.fixture
def own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names that a test registers are forgotten after it."""
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))


@pytest.mark.parametrize("name", MODULES)
def test_a_module_of_another_library_keeps_the_laws(name: str) -> None:
    check_memory(RecurrentMemory(MODULES[name](), D, H))


@pytest.mark.parametrize("name", MODULES)
def test_each_episode_is_what_the_module_alone_gives(name: str) -> None:
    module = MODULES[name]()

    def alone(x: Tensor) -> Tensor:
        if getattr(module, "batch_first", True):
            return module(x[None])[0][0]  # type: ignore[no-any-return]
        return module(x[:, None])[0][:, 0]  # type: ignore[no-any-return]

    assert_each_episode(RecurrentMemory(module, D, H), alone, tolerance=1e-6)


def test_the_state_has_the_batch_first_and_the_types_of_the_module() -> None:
    state = RecurrentMemory(ManyLeaves(), D, H).double().initial_state([2, 5])
    assert {name: (leaf.dtype, list(leaf.shape)) for name, leaf in state.items()} == {
        "0": (torch.float64, [2, 5, H]),
        "1": (torch.float64, [2, 5, H]),
        "2": (torch.float64, [2, 5, 1, H]),
        "3": (torch.int64, [2, 5]),
    }


def test_a_start_of_its_own_is_where_every_episode_begins_and_is_trained() -> None:
    memory = learned_start()
    check_memory(memory)
    x = torch.randn(2, 4, D)
    flags = torch.tensor([[False, False, True, False], [False] * 4])
    y, _ = memory(x, memory.initial_state(2), flags)
    expected, _ = run_steps(memory.module, x[:1, 2:], start_learned(memory.module, 1))
    torch.testing.assert_close(y[:1, 2:], expected)
    y[0, 2:].sum().backward()
    assert memory.module.begins_with.grad.abs().min() > 0


class Swaps(nn.Module):
    """Returns its dictionary in another order than that in which it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm = nn.LSTM(D, H, batch_first=True)

    def forward(self, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        y, (h, c) = self.lstm(x, (state["h"][None], state["c"][None]))
        return y, {"c": c[0], "h": h[0]}


def test_tensors_of_a_dictionary_go_by_their_keys() -> None:
    def start(module: nn.Module, batch_size: int) -> Any:
        return {"h": torch.ones(batch_size, H), "c": torch.zeros(batch_size, H)}

    memory = RecurrentMemory(Swaps(), D, H, start=start)
    assert memory.initial_state(1)["0"].sum() == H
    x = torch.randn(1, 6, D)
    flags = torch.tensor([[True, False, False, True, False, False]])
    y, _ = memory(x, memory.initial_state(1), flags)
    begin = (torch.ones(1, 1, H), torch.zeros(1, 1, H))
    expected = [memory.module.lstm(part, begin)[0] for part in x.split(3, dim=1)]
    torch.testing.assert_close(y, torch.cat(expected, dim=1))
    check_memory(memory)


@pytest.mark.parametrize("nothing", [None, (), {}, [(), None]], ids=str)
@pytest.mark.parametrize("begins", [False, True], ids=["", "with a start"])
def test_a_module_without_a_state_is_a_memory(nothing: Any, begins: bool) -> None:
    calls = []

    def run(module: nn.Module, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        calls.append(x.shape[1])
        return module(x), nothing

    start = (lambda module, batch_size: nothing) if begins else None
    memory = RecurrentMemory(nn.Linear(D, H), D, H, run=run, start=start)
    check_memory(memory)
    calls.clear()
    y, state = memory(torch.ones(2, 5, D), memory.initial_state(2), torch.ones(2, 5).bool())
    assert calls == [5]
    assert y.shape == (2, 5, H) and state.batch_size == (2,) and state.is_empty()


class StartsAtParameter(nn.Module):
    """Begins with a parameter, and multiplies its output with another."""

    def __init__(self, start: float, factor: float) -> None:
        super().__init__()
        self.gru = nn.GRU(D, H, batch_first=True)
        self.start = nn.Parameter(torch.full((1, 1, H), start))
        self.factor = nn.Parameter(torch.tensor(factor))

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        if state is None:
            state = self.start.expand(1, len(x), H).contiguous()
        y, h = self.gru(x, state)
        return self.factor * y, h


@pytest.mark.parametrize(("start", "factor"), [(0.0, 1.0), (1.0, 0.0)])
def test_a_start_that_is_learned_from_zeros_on_or_hidden_by_a_zero_is_asked_for(
    start: float, factor: float
) -> None:
    module = StartsAtParameter(start, factor)
    with pytest.raises(ValueError, match=r"or learns what it begins with.*start=lambda"):
        RecurrentMemory(module, D, H)
    torch.testing.assert_close(module.start.data, torch.full((1, 1, H), start))
    fixed = StartsAtParameter(0.0, 1.0)
    fixed.start.requires_grad_(False)
    check_memory(RecurrentMemory(fixed, D, H))


class Counted(nn.Module):
    """Counts its calls and drops out, its last part in evaluation mode."""

    def __init__(self) -> None:
        super().__init__()
        self.gru = nn.GRU(D, H, batch_first=True)
        self.frozen = nn.Dropout(0.5).eval()
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        self.calls += 1
        y, h = self.gru(x, state)
        return self.frozen(y), h


def test_to_make_one_leaves_parts_and_buffers_as_they_are() -> None:
    module = Counted()
    RecurrentMemory(module, D, H)
    assert [part.training for part in module.children()] == [True, False]
    assert module.calls == 0


OUTSIDE = nn.GRU(D, H, batch_first=True)


def run_outside(module: nn.Module, x: Tensor, state: Any) -> tuple[Tensor, Any]:
    return OUTSIDE(x, state)  # type: ignore[no-any-return]


@pytest.mark.parametrize("is_global", [True, False])
def test_a_run_that_names_the_module_itself_breaks_a_law(is_global: bool) -> None:
    inside = nn.GRU(D, H, batch_first=True)
    run = run_outside if is_global else lambda module, x, state: inside(x, state)
    memory = RecurrentMemory(OUTSIDE if is_global else inside, D, H, run=run)
    # copied, it would go on with the weights of the first; here in the type that both have
    with pytest.raises(MemoryLawError, match=r"what is in _read .*take the module that") as info:
        check_memory(memory, dtype=torch.float32)
    assert info.value.law == "weights are registered"


class Stepwise(nn.Module):
    """Plain operators, which ``vmap`` knows."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(D, H)

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        h = x.new_zeros(len(x), H) if state is None else state
        outputs = []
        for inputs in self.linear(x).unbind(1):
            h = torch.tanh(inputs + 0.9 * h)
            outputs.append(h)
        return torch.stack(outputs, 1), h


def test_several_read_at_once_with_their_own_starts() -> None:
    memories = [RecurrentMemory(Stepwise(), D, H) for _ in range(3)]
    stacked = torch.func.stack_module_state(memories)
    x = torch.randn(3, 2, 7, D)
    flags = torch.rand(3, 2, 7) < 0.4

    def one(weights: Any, buffers: Any, x: Tensor, flags: Tensor) -> Tensor:
        inputs = (x, memories[0].initial_state(2), flags)
        return torch.func.functional_call(memories[0], (weights, buffers), inputs)[0]

    together = torch.func.vmap(one)(*stacked, x, flags)
    for number, memory in enumerate(memories):
        y, _ = memory(x[number], memory.initial_state(2), flags[number])
        torch.testing.assert_close(together[number], y)


@pytest.mark.parametrize("module", [nn.RNN(D, H), nn.GRU(D, H, batch_first=True), nn.LSTM(D, H, 2)])
def test_a_module_that_knows_no_vmap_is_told_with_what_reads_without(module: nn.Module) -> None:
    """By which ``GAE`` and losses of two critics read. Before: an error of torch about ``aten``."""
    memory = RecurrentMemory(module, D, H)
    x, flags = torch.zeros(2, 3, 5, D), torch.zeros(3, 5, dtype=torch.bool)
    says = rf"^{type(module).__name__} knows no vmap.*deactivate_vmap=True"
    with pytest.raises(RuntimeError, match=says) as info:
        torch.func.vmap(lambda x: memory(x, memory.initial_state(3), flags)[0])(x)
    assert "\n" not in str(info.value)
    other = RecurrentMemory(Stepwise(), D, H)
    other.module.linear = nn.Linear(D + 1, H)
    with pytest.raises(RuntimeError, match="shapes cannot be multiplied"):  # torch's own, as it is
        other(x[0], other.initial_state(3), flags)


def test_to_make_one_changes_neither_the_module_nor_random_numbers() -> None:
    module = nn.LSTM(D, H, num_layers=2, dropout=0.5)
    before = torch.random.get_rng_state()
    memory = RecurrentMemory(module, D, H)
    assert torch.equal(before, torch.random.get_rng_state())
    assert module.training and memory.module is module
    assert list(memory.state_dict()) == [f"module.{name}" for name in module.state_dict()]
    assert copy.deepcopy(memory).state_leaves() == memory.state_leaves()


def test_it_is_made_where_tensors_have_no_data() -> None:
    with torch.device("meta"):
        memory = RecurrentMemory(nn.GRU(D, H), D, H)
    assert memory.initial_state(2)["0"].is_meta


def test_a_loss_trains_it_by_its_name(own_names: None) -> None:
    register_memory("stacked", lambda d, h: RecurrentMemory(nn.LSTM(d, h, num_layers=2), d, h))
    network = make_network("small", memory="stacked", hidden_size=16)
    env = make("SignpostEasy", num_envs=2, seed=0)
    collector = ArcadeCollector(
        env, make_policy(network, epsilon=0.5), frames_per_batch=64, final_frames="truncated"
    )
    PQNLoss(network)(collector.collect())["loss"].backward()
    weights = {name: weight for name, weight in network.named_parameters() if "weight_hh" in name}
    assert len(weights) >= 2
    assert all(weight.grad.abs().max() > 0 for weight in weights.values())


def test_it_stands_where_torchrls_lstm_module_does() -> None:
    memory = RecurrentMemory(nn.GRU(D, H), D, H)
    module = MemoryModule(memory, in_key="x", out_key="y")
    window = TensorDict({"x": torch.randn(2, 5, D)}, batch_size=[2, 5])
    window["is_init"] = torch.zeros(2, 5, 1, dtype=torch.bool)
    with set_recurrent_mode(True):
        y = module(window)["y"]
    torch.testing.assert_close(y, memory.module(window["x"].transpose(0, 1))[0].transpose(0, 1))


class Grows(nn.Module):
    """Keeps every step it has read."""

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        read = x if state is None else torch.cat([state, x], 1)
        return x, read


class Cell(nn.Module):
    """Reads one step; three axes are no error."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(D, H)

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        h = torch.tanh(self.linear(x) if state is None else self.linear(x) + state)
        return h, h


class OneForAll(nn.Module):
    """One state for the whole batch."""

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        return x, x.mean((0, 1))


class Counts(nn.Module):
    """A number in its state."""

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        return x, (x[:, -1], 1)


class BeginsWithOnes(nn.Module):
    """What it begins with, given None, is not zeros."""

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        h = torch.ones_like(x[:, 0]) if state is None else state
        return x + h[:, None], h


class KeepsItsState(nn.Module):
    """Goes on from the call before when it is given None."""

    def __init__(self) -> None:
        super().__init__()
        self.gru = nn.GRU(D, H, batch_first=True)
        self.h: Tensor | None = None

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor]:
        before = self.h if state is None else state
        if before is not None and before.shape[1] != len(x):
            before = None
        y, self.h = self.gru(x, before)
        return y, self.h


class Inside(nn.Module):
    """Does not say that time is the first axis of what is in it."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm = nn.LSTM(D, H)

    def forward(self, x: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        return self.lstm(x, state)  # type: ignore[no-any-return]


class TimeFirst(nn.Module):
    """Written by hand as ``nn.LSTM`` is: time first, and it needs a state."""

    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRUCell(D, H)

    def forward(self, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        outputs = []
        for inputs in x:
            state = self.cell(inputs, state)
            outputs.append(state)
        return torch.stack(outputs), state


def start_of_time_first(module: nn.Module, batch_size: int) -> Tensor:
    return torch.zeros(batch_size, H)


def test_a_module_of_ones_own_says_that_time_is_its_first_axis() -> None:
    module = TimeFirst()
    module.batch_first = False
    check_memory(RecurrentMemory(module, D, H, start=start_of_time_first))


def run_by_rows(module: nn.Module, x: Tensor, state: Any) -> tuple[Tensor, Any]:
    return x, tuple(x.sum(1) for _ in x)


def run_with_more(module: nn.Module, x: Tensor, state: Any) -> Any:
    return x, state, {}


def one_of_batch(module: nn.Module, batch_size: int) -> Tensor:
    return torch.zeros(1, batch_size, 1)


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (
            lambda: RecurrentMemory(nn.LSTM(D, H), D, 5),
            ValueError,
            r"makes \[2, 1, 4\].*\[2, 1, 5\]",
        ),
        (lambda: RecurrentMemory(nn.LSTM(7, H), D, H), TypeError, "Expected 7, got 3.*run=lambda"),
        (lambda: RecurrentMemory(nn.Linear(D, H), D, H), TypeError, "cannot be run.*run=lambda"),
        (lambda: RecurrentMemory(nn.Identity(), D, D), TypeError, "cannot be run.*run=lambda"),
        (
            lambda: RecurrentMemory(nn.Linear(D, H), D, H, run=lambda m, x, s: m(x)),
            TypeError,
            r"gives Tensor and not \(y, state\)",
        ),
        (lambda: RecurrentMemory(Grows(), D, D), ValueError, "after one step.*window of fixed"),
        (lambda: RecurrentMemory(OneForAll(), D, D), ValueError, "has to be the batch"),
        (lambda: RecurrentMemory(Counts(), D, D), TypeError, "holds int, and not tensors.*run="),
        (lambda: RecurrentMemory(BeginsWithOnes(), D, D), ValueError, "than zeros.*start=lambda"),
        (
            lambda: RecurrentMemory(nn.GRU(D, H), D, H, start=one_of_batch),
            TypeError,
            "the state of start.*what it begins with by start=",
        ),
        (lambda: RecurrentMemory(nn.GRU(D, H), 0, H), ValueError, "sizes must be positive"),
        (lambda: RecurrentMemory(nn.GRU, D, H), TypeError, "the class GRU: make one of it"),
        (lambda: RecurrentMemory(nn.LazyLinear(H), D, H), TypeError, "no shape before the first"),
        (lambda: RecurrentMemory(nn.GRUCell(D, H), D, H), TypeError, r"run= with a loop over x\."),
        (lambda: RecurrentMemory(Cell(), D, H), ValueError, r"run= with a loop over x\.unbind"),
        (
            lambda: RecurrentMemory(KeepsItsState(), D, H),
            ValueError,
            "two equal calls of KeepsItsState differ.*keeps its state in itself",
        ),
        (
            lambda: RecurrentMemory(Inside(), D, H),
            ValueError,
            "whatever the batch.*time for its.*batch_first = False on it",
        ),
        (
            lambda: RecurrentMemory(TimeFirst(), D, H, start=start_of_time_first),
            TypeError,
            "the state of start.*batch_first = False on it, where time is its first axis",
        ),
        (
            lambda: RecurrentMemory(nn.GRU(D, H), D, H, start=torch.zeros),
            TypeError,
            r"start of GRU fails.*called as start\(module, batch_size\)",
        ),
        (
            lambda: RecurrentMemory(nn.GRU(D, H), D, H, start=lambda module, batch_size: None),
            ValueError,
            r"start gives a state of no tensor, and GRU returns one of \[1, 2, 4\]",
        ),
        (
            lambda: RecurrentMemory(nn.Linear(D, D), D, D, run=run_with_more),
            TypeError,
            r"gives \(Tensor, NoneType, dict\) and not \(y, state\)",
        ),
        (
            lambda: RecurrentMemory(nn.Linear(D, D), D, D, run=run_by_rows),
            ValueError,
            "1: .* for a batch of two and .*2: .* for one of three",
        ),
        (
            lambda: RecurrentMemory(Carries(lambda h: {"h": h}, lambda s: s.h), D, H),
            TypeError,
            "a state of zeros .*no attribute 'h'.*run=lambda",
        ),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(make: Any, error: Any, said: str) -> None:
    with pytest.raises(error, match=said) as info:
        make()
    assert "\n" not in str(info.value)


@pytest.mark.parametrize(
    ("module", "width", "law"),
    [
        (nn.LSTM(D, H, bidirectional=True), 2 * H, "scan equals step by step"),
        (nn.LSTM(D, H, 2, dropout=0.5), H, "equal calls give equal results"),
    ],
)
def test_what_is_no_memory_breaks_a_law(module: nn.Module, width: int, law: str) -> None:
    with pytest.raises(MemoryLawError) as info:
        check_memory(RecurrentMemory(module, D, width))
    assert info.value.law == law
