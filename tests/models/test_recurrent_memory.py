"""``RecurrentMemory``: modules of other libraries, of every layout that is about, keep the laws."""

import copy
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


MODULES = {
    "RNN": lambda: nn.RNN(D, H, batch_first=True),
    "GRU, time first": lambda: nn.GRU(D, H),
    "LSTM of two layers": lambda: nn.LSTM(D, H, num_layers=2),
    "LSTM with a projection": lambda: nn.LSTM(D, 6, proj_size=H, batch_first=True),
    "LSTM of TorchRL": lambda: TorchRLLSTM(D, H, batch_first=True),
    "GRU of TorchRL": lambda: TorchRLGRU(D, H),
    "all containers": ManyLeaves,
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
            r"gives a Tensor and not \(y, state\)",
        ),
        (lambda: RecurrentMemory(Grows(), D, D), ValueError, "after one step.*window of fixed"),
        (lambda: RecurrentMemory(OneForAll(), D, D), ValueError, "has to be the batch"),
        (lambda: RecurrentMemory(Counts(), D, D), TypeError, "holds a int.*run="),
        (lambda: RecurrentMemory(BeginsWithOnes(), D, D), ValueError, "than zeros.*start=lambda"),
        (
            lambda: RecurrentMemory(nn.GRU(D, H), D, H, start=one_of_batch),
            TypeError,
            "the state of start.*what it begins with by start=",
        ),
        (lambda: RecurrentMemory(nn.GRU(D, H), 0, H), ValueError, "sizes must be positive"),
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
