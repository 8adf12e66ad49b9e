"""The example of a memory of one's own: its laws, its starts, and that the stock tools take it."""

import importlib.util
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from arcade_torch.models import check_memory, make_memory, registry
from arcade_torch.models.memory import replay
from arcade_torch.tools import cli
from arcade_torch.tools.bench.memory_tests.table import Row
from arcade_torch.tools.files import read_rows
from arcade_torch.tools.imports import VARIABLE

FILE = Path(__file__).resolve().parents[1] / "examples/own_memory.py"


@pytest.fixture
def own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names that a test registers are forgotten after it."""
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    monkeypatch.setenv(VARIABLE, "")


@pytest.fixture
def lstm(own_names: None) -> Any:
    """The example's model, made by its name."""
    spec = importlib.util.spec_from_file_location("own_memory_example", FILE)
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return make_memory("torch_lstm", 3, 4)


def test_the_class_and_its_registration_take_under_thirty_lines() -> None:
    source = FILE.read_text()
    code = source[source.index("class LSTM") : source.index("\nif __name__")]
    assert len([line for line in code.splitlines() if line.strip()]) < 30


def test_it_keeps_the_laws_alone_and_in_a_network(lstm: Any) -> None:
    check_memory(lstm)
    check_memory(make_memory("torch_lstm", 5, 2))


def test_starts_inside_a_sequence_equal_torchs_lstm_on_each_episode_alone(lstm: Any) -> None:
    x, is_init = torch.randn(3, 12, 3), torch.zeros(3, 12, dtype=torch.bool)
    episodes = [[0, 5, 6, 12], [0, 12], [0, 1, 9, 12]]
    for row, borders in enumerate(episodes):
        is_init[row, borders[1:-1]] = True
    y, _ = lstm(x, lstm.initial_state(3), is_init)
    for row, borders in enumerate(episodes):
        for begin, end in pairwise(borders):
            alone, _ = lstm.lstm(x[row : row + 1, begin:end])
            torch.testing.assert_close(y[row : row + 1, begin:end], alone)


def test_a_buffer_replays_it_step_by_step_though_it_has_no_replay(lstm: Any) -> None:
    x, is_init = torch.randn(2, 6, 3), torch.zeros(2, 6, dtype=torch.bool)
    y, last = lstm(x, lstm.initial_state(2), is_init)
    stored = lstm.initial_state([2, 6])
    replayed, states = replay(lstm, x, stored, is_init)
    torch.testing.assert_close(replayed, y)
    torch.testing.assert_close(states[:, -1]["c"], last["c"])


@pytest.mark.usefixtures("own_names")
def test_it_trains_and_is_evaluated_and_tested_with_the_stock_tools(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "--memory",
        "torch_lstm",
        "--preset",
        "smoke",
        "--env",
        "SignpostEasy",
        "--out",
        str(tmp_path / "run"),
    ]
    assert cli.main(["train", "--import", str(FILE), *words]) == cli.EXIT_OK
    assert cli.main(["evaluate", str(tmp_path / "run"), "--episodes", "4"]) == cli.EXIT_OK
    assert "SignpostEasy-v0" in capsys.readouterr().out

    out = tmp_path / "tests.csv"
    words = ["--tests", "parity", "--memory", "torch_lstm", "--steps", "3", "--seeds", "1"]
    words += ["--hidden-size", "8", "--out", str(out)]
    assert cli.main(["bench", "recall", "--import", str(FILE), *words]) == cli.EXIT_OK
    assert {(row.model, row.test) for row in read_rows(out, Row)} == {("torch_lstm", "parity")}
