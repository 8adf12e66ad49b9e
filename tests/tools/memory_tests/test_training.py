"""The tests of memory separate what theory separates; results are kept, drawn and written down."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from arcade_torch.models import MemoryBlock, make_memory
from arcade_torch.tools import cli
from arcade_torch.tools.bench.memory_tests import TESTS, table, training
from arcade_torch.tools.bench.memory_tests.batch import Batch, MemoryTest
from arcade_torch.tools.bench.memory_tests.delay import DELAY, SYMBOLS
from arcade_torch.tools.bench.memory_tests.table import Row, cells, markdown
from arcade_torch.tools.bench.memory_tests.training import Setting, Trained, train
from arcade_torch.tools.bench.recall import TestName
from arcade_torch.tools.files import read_rows

QUICK = Setting(hidden_size=16, steps=20)


@torch.no_grad()
@pytest.mark.parametrize(
    ("memory", "options", "reach"),
    [("attention", {}, 127), ("attention", {"window": 9}, 8), ("frame_stack", {"frames": 6}, 5)],
)
def test_beyond_a_window_the_symbol_has_no_influence_at_all(
    memory: str, options: dict[str, int], reach: int
) -> None:
    """The same episode with each of the four symbols: exactly one of the four answers is right."""
    block = MemoryBlock(DELAY.inputs, 16, memory, layers=1, memory_options=options)
    head = torch.nn.Linear(16, SYMBOLS)
    for distance, in_reach in ((reach, True), (reach + 1, False)):
        inputs = DELAY.batch(0, 8, distance - 1).inputs.repeat(SYMBOLS, 1, 1)
        symbols = torch.arange(SYMBOLS).repeat_interleave(8)
        inputs[:, 0] = torch.nn.functional.one_hot(symbols, DELAY.inputs).float()
        starts = torch.zeros(inputs.shape[:2], dtype=torch.bool)
        y, _ = block(inputs, block.initial_state(len(inputs)), starts)
        logits = head(y[:, -1]).view(SYMBOLS, 8, SYMBOLS)
        assert torch.equal(logits, logits[:1].expand_as(logits)) is not in_reach
        if not in_reach:
            assert int((logits.argmax(-1).flatten() == symbols).sum()) == 8


@pytest.mark.parametrize("test", TESTS.values(), ids=lambda test: test.name)
def test_the_control_is_at_chance(test: MemoryTest) -> None:
    chance = float(test.chance)
    for share, asked in train("mlp", test, 0, QUICK).accuracy.values():
        assert asked >= QUICK.answers
        # answers of one episode are not independent: twice the spread of independent ones
        assert abs(share - chance) < 2 * 4 * math.sqrt(chance * (1 - chance) / asked)


def test_a_gru_tracks_parity_beyond_what_it_learned_and_a_mingru_does_not() -> None:
    """arXiv 2411.12537: a diagonal scan with factors from 0 to 1 has no parity; measured .50."""
    setting = Setting(hidden_size=32, steps=400)
    assert train("gru", TESTS["parity"], 0, setting).accuracy[64][0] > 0.95
    assert train("mingru", TESTS["parity"], 0, setting).accuracy[64][0] < 0.55


def test_a_delta_rule_tracks_parity_if_its_factors_may_be_negative_and_not_otherwise() -> None:
    """arXiv 2411.12537: 1 - beta has to reach below zero; beta goes to 2 by default."""
    setting = Setting(hidden_size=32, steps=400)
    positive = partial(make_memory, "gdn", beta_range=1.0)
    assert train("gdn", TESTS["parity"], 0, setting).accuracy[64][0] > 0.9
    assert train(positive, TESTS["parity"], 0, setting).accuracy[64][0] < 0.55


def test_equal_seeds_give_equal_results_and_training_ends_when_it_is_solved() -> None:
    setting = Setting(hidden_size=16, steps=400, answers=200)
    first = train("gdn", DELAY, 3, setting)
    again = train("gdn", DELAY, 3, setting)
    assert first.accuracy == again.accuracy and first.steps == again.steps
    assert first.accuracy[16][0] > 0.95 and first.steps < 400
    assert first.accuracy != train("gdn", DELAY, 4, setting).accuracy


def test_what_is_learned_what_ends_a_training_and_what_is_asked_are_different_data(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of all runs: no episode of a test was seen in a training, its own or another seed's."""
    draw = MemoryTest.batch
    drawn: list[tuple[int, int]] = []

    def recorded(self: MemoryTest, seed: int, rows: int, level: int) -> Batch:
        drawn.append((seed, rows))
        return draw(self, seed, rows, level)

    monkeypatch.setattr(MemoryTest, "batch", recorded)
    monkeypatch.setattr(training, "_learn", lambda *arguments: None)
    setting = replace(QUICK, steps=600, rows=2, check_every=100, answers=600)
    for seed in (0, 1):
        train("mlp", TESTS["rewriting"], seed, setting)
    learned = [seed for seed, rows in drawn if rows == setting.rows]
    others = [seed for seed, rows in drawn if rows != setting.rows]
    assert len(learned) == 2 * 600
    assert len(others) == 2 * (6 + 3 * 2)
    assert len({seed for seed, _ in drawn}) == len(drawn)


def test_rows_of_another_setting_or_without_a_size_are_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainings = []

    def trained(memory: str, test: MemoryTest, seed: int, setting: Setting) -> Trained:
        trainings.append((memory, test.name, seed, setting.hidden_size, setting.steps))
        return Trained(dict.fromkeys(test.tested, (0.5, 1000)), setting.steps, 1.0, 10, 4)

    monkeypatch.setattr(table, "train", trained)
    file = tmp_path / "t.csv"
    for setting in (QUICK, QUICK, replace(QUICK, steps=30), replace(QUICK, hidden_size=8)):
        rows = list(table.measured(file, ["gru"], [DELAY], [0], setting, lambda line: None))
        assert {(row.hidden_size, row.most_steps) for row in rows} == {
            (setting.hidden_size, setting.steps)
        }
        assert [row.level for row in rows] == list(DELAY.tested)
    assert [key[3:] for key in trainings] == [(16, 20), (16, 30), (8, 20)]
    assert len(list(table.measured(file, ["gru"], [DELAY], [1], QUICK, lambda line: None))) == 3
    assert len(trainings) == 4


WORDS = ["bench", "recall", "--tests", "parity", "delay", "--steps", "3", "--hidden-size", "8"]


def test_the_command_keeps_its_rows_and_writes_page_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "page.md"
    out = tmp_path / "t.csv"
    page.write_text(f"before\n{table.BEGIN}old{table.END}\nafter\n")
    words = [*WORDS, "--memory", "mlp", "gru", "--seeds", "2", "--out", str(out)]
    words += ["--page", str(page)]
    assert cli.main(words) == cli.EXIT_OK
    log = capsys.readouterr().err
    assert "measuring mlp, parity, seed 0" in log and "measuring gru, delay, seed 1" in log
    rows = read_rows(out, Row)
    assert len(rows) == 2 * 2 * (2 + 3) and {row.most_steps for row in rows} == {3}
    text = page.read_text()
    assert markdown(rows, ["gru", "mlp"]) in text and "old" not in text
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")

    monkeypatch.setattr(table, "train", None)  # nothing is measured again
    assert cli.main(words) == cli.EXIT_OK and page.read_text() == text
    words.remove("gru")  # whose rows stay on the page
    assert cli.main(words) == cli.EXIT_OK and page.read_text() == text
    assert read_rows(out, Row) == rows


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--tests", "symbol", "delay"], "--tests must be symbol alone"),
        (["--tests", "delays"], "delay"),
        (["--tests", "delay", "--memory", "gruu"], "did you mean 'gru'"),
        (["--tests", "delay", "--steps", "0"], "steps"),
        (["--tests", "delay", "--seeds", "0"], "seeds"),
    ],
)
def test_bad_input_is_refused_in_one_line_before_anything_is_measured(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "recall", *words]) == cli.EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert line in error and len(error.strip().splitlines()) == 1


def test_the_command_line_names_every_test() -> None:
    assert set(TestName.__args__) == {"symbol", *TESTS}


def row(model: str, accuracy: float, seed: int = 0, level: int = 16) -> Row:
    return Row(model, "delay", level, seed, 64, 800, accuracy, 1000, 100, 1.0, 10, 4)


def test_verdicts_go_by_the_share_of_what_a_guess_misses() -> None:
    rows = [row("a", 0.97), row("b", 0.28), row("c", 0.95), row("c", 0.55, seed=1)]
    found = cells(rows)
    assert [found[name, "delay", 16].verdict for name in "abc"] == ["solved", "chance", "partly"]
    both = found["c", "delay", 16]
    assert both.accuracy == pytest.approx(0.75) and both.score == pytest.approx(2 / 3)
    assert (both.low, both.high) == (0.55, 0.95) and both.seeds == 2


def test_the_table_says_sizes_chance_verdicts_and_intervals() -> None:
    rows = [row("a", 1.0), row("a", 0.25, level=64), row("b", 0.95), row("b", 0.55, seed=1)]
    assert markdown(rows, ["a", "b"]).splitlines()[2:] == [
        "| `delay` | 16 steps between | 25.0 | **100** | 75 [55, 95] |",
        "| `delay` | 64 steps between, new | 25.0 | (25) |  |",
    ]
