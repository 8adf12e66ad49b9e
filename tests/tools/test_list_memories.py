"""`arcade-torch list memories` says what every model costs, and the counts are exact."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models import RecurrentMemory, make_memory, memory_names
from arcade_torch.tools import cli
from arcade_torch.tools.bench.memory import memory_cost, time_memories


def test_every_model_is_listed_with_its_parameters_state_and_arithmetic(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["list", "memories"]) == 0
    out = capsys.readouterr().out
    assert all(f" {name} " in out for name in memory_names())
    assert "512 wide" in out and "128 wide" in out
    for number in ("1,050,624", "131,073", "524,296", "48,642", "1,572,864"):
        assert number in out


@pytest.mark.parametrize(
    ("name", "numbers", "size_in_bytes", "products"),
    [
        ("mlp", 0, 0, 8 * 8),
        ("mingru", 8, 32, 2 * 8 * 8),
        ("gru", 8, 32, 6 * 8 * 8),
        ("lstm", 16, 64, 8 * 8 * 8),
        ("frame_stack", 24, 96, 4 * 8 * 8),
        ("lru", 16, 64, 4 * 8 * 8),
        ("ffm", 16, 64, 4 * 8 + 16 * 8 + 2 * 8 * 8),
        ("shm", 10, 44, 8 * 13 + 3 * 3 + 3 * 8),
        ("rtu", 16, 64, 4 * 8 * 8),
        ("deltaproduct", 9, 36, 8 * (5 * 3 + 3) + 6 * 3 * 3 + 3 * 8),
        ("rwkv7", 17, 68, 2 * 8 * 6 * 3 + 2 * 3 * 3 + 3 * 8),
        ("s5", 8, 32, 8 * 8 + 8 * 8),
        ("mamba", 88, 4 * 88, 2 * 64 + 8 * 17 + 8 + 8 * 8 + 64),
        ("slstm", 32, 128, 8 * 8 * 8),
        ("mlstm", 13, 52, 8 * (9 + 2 + 3 + 3) + 2 * 3 * 4),
        ("gtrxl", 128 * 16 + 1, 128 * 8 * 8 + 8, 17 * 8 * 8 + 2 * 128 * 8),
        ("bmru", 8, 32, 2 * 8 * 8),
        ("linear_transformer", 12, 48, 3 * 8 * 3 + 3 * 4 + 3 * 4 + 3 * 8),
        ("attention", 128 * 16 + 1, 128 * 8 * 8 + 8, 3 * 8 * 8 + 2 * 128 * 8),
    ],
)
def test_costs_are_those_counted_by_hand(
    name: str, numbers: int, size_in_bytes: int, products: int
) -> None:
    cost = memory_cost(make_memory(name, 8, 8), 8)
    assert (cost.state_numbers, cost.state_bytes, cost.products) == (
        numbers,
        size_in_bytes,
        products,
    )


def test_times_are_positive_and_learning_a_batch_takes_longer_than_acting_it() -> None:
    times = time_memories(["gru", "mlp"], 8, seconds=0.01, repeats=1)
    assert set(times) == {"gru", "mlp"}
    assert all(acting > 0 and learning > 0 for acting, learning in times.values())
    assert times["gru"][1] > times["mlp"][1]


def test_products_inside_of_a_fused_lstm_count() -> None:
    memory = RecurrentMemory(nn.LSTM(8, 16, batch_first=True), 8, 16)
    assert memory_cost(memory, 8).products == (8 + 16) * 4 * 16


class LastInput(nn.Module):
    """Somebody's memory without a weight: the input of the step before."""

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        before = torch.cat([state["x"].unsqueeze(1), x[:, :-1]], dim=1)
        y = before.masked_fill(is_init.unsqueeze(-1), 0)
        return y, TensorDict({"x": x[:, -1].clone()}, batch_size=[len(x)])

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"x": torch.zeros(batch_size, 8)}, batch_size=[batch_size])


def test_a_memory_without_a_weight_costs_its_state() -> None:
    assert memory_cost(LastInput(), 8) == (0, 8, 32, 0)
