"""Delayed recall: what is asked can be known, who has no memory guesses, and windows reach as far
as theory says.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from arcade_torch.models import MemoryBlock, memory_names
from arcade_torch.tools import cli
from arcade_torch.tools.bench import recall
from arcade_torch.tools.bench.recall import ASK, SOLVED, UNLABELLED, Recall, train, windows
from arcade_torch.tools.files import read_rows, write_csv


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("delay", [1, 4, 32])
def test_the_answer_is_the_symbol_at_the_last_start_and_distractors_stand_between(
    delay: int, mixed: bool
) -> None:
    batch = windows(np.random.default_rng(0), 64, delay, mixed=mixed)
    waits = []
    for tokens, is_init, answers in zip(batch.tokens, batch.is_init, batch.answers, strict=True):
        starts = is_init.nonzero().flatten()
        assert starts[0] == 0
        for asked in (answers != UNLABELLED).nonzero().flatten():
            begin = starts[starts <= asked][-1]
            assert tokens[asked] == ASK and answers[asked] == tokens[begin] < 4
            between = tokens[begin + 1 : asked]
            assert ((between >= 4) & (between < ASK)).all()
            waits.append(len(between))
            assert asked == len(tokens) - 1 or is_init[asked + 1]
        assert (tokens < 4).eq(is_init).all() and (tokens == ASK).eq(answers != UNLABELLED).all()
    assert max(waits) == delay and (min(waits) == delay) is (delay == 1 or not mixed)


def test_a_quarter_of_the_episodes_ends_before_the_question_and_symbols_are_even() -> None:
    batch = windows(np.random.default_rng(1), 4000, 4)
    first_asked = batch.answers[:, 5] != UNLABELLED
    in_time = first_asked & ~batch.is_init[:, 1:6].any(1)
    assert in_time.double().mean() == pytest.approx(0.75, abs=0.03)
    shares = (
        torch.bincount(batch.answers[batch.answers != UNLABELLED])
        / (batch.answers != UNLABELLED).sum()
    )
    assert shares.numpy() == pytest.approx(np.full(4, 0.25), abs=0.03)


def test_one_model_learns_it() -> None:
    row = train("mingru", 4, hidden_size=32, seconds=20, answers=400)
    assert row.accuracy >= SOLVED and row.answers >= 400 and row.steps % recall.CHECK_EVERY == 0
    assert row.state_numbers == 32


def test_the_stateless_cell_guesses() -> None:
    row = train("mlp", 4, hidden_size=16, seconds=0.5, answers=1000)
    assert row.accuracy < 0.32 and row.state_numbers == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in memory_names() if name not in ("mlp", "frame_stack")]
)
def test_every_memory_remembers_for_eight_steps(name: str) -> None:
    assert train(name, 8).accuracy >= SOLVED


@pytest.mark.parametrize(("layers", "window"), [(1, 32), (1, 34), (2, 17), (2, 24)])
def test_the_question_is_out_of_reach_of_attention_exactly_where_theory_says(
    layers: int, window: int
) -> None:
    delay = 32  # and the question comes 33 steps after the symbol
    block = MemoryBlock(3, 8, "attention", layers=layers, memory_options={"window": window})
    x, is_init = (
        torch.randn(1, delay + 2, 3, requires_grad=True),
        torch.zeros(1, delay + 2, dtype=torch.bool),
    )
    y, _ = block(x, block.initial_state(1), is_init)
    (gradient,) = torch.autograd.grad(y[:, -1].square().sum(), x)
    in_reach = layers * (window - 1) >= delay + 1
    assert bool((gradient[:, 0] != 0).any()) is in_reach


def test_the_command_keeps_its_rows_and_writes_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    page, out = tmp_path / "page.md", tmp_path / "r.csv"
    page.write_text(f"before\n{recall.BEGIN}old{recall.END}\nafter\n")
    words = [
        "bench",
        "recall",
        "gdn",
        "--delays",
        "1",
        "2",
        "--hidden-size",
        "8",
        "--seconds",
        "0.2",
    ]
    words += ["--out", str(out), "--page", str(page)]
    threads = torch.get_num_threads()
    assert cli.main(words) == cli.EXIT_OK
    assert (
        torch.get_num_threads() == threads and "measuring gdn, delay 2" in capsys.readouterr().err
    )
    text = page.read_text()
    assert recall.markdown(read_rows(out, Recall)) in text
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
    assert "| `gdn` | " in text and "| delay 1 | delay 2 |" in text
    monkeypatch.setattr(recall, "train", None)
    assert cli.main(words) == cli.EXIT_OK and page.read_text() == text
    others = [Recall("window of old", 1, 8, 0, 1.0, 9, 9, 9.0, 9, 9), *read_rows(out, Recall)]
    others += [Recall("lru", 1, size, 0, 0.5, 9, 9, 9.0, 9, size) for size in (8, 16)]
    write_csv(out, [row._asdict() for row in others], Recall._fields)
    assert cli.main(words) == cli.EXIT_OK
    text = page.read_text()  # the rows of others stay, of this width and of models there are
    assert text.index("| `lru` | 50.0 % ") < text.index("| `gdn` | ") and text.count("`lru`") == 1
    assert "| 9 | 8 |" in text and "window of old" not in text
    out.write_text("a,b\n1,2\n")
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    assert "is no table with columns model, delay, hidden_size" in capsys.readouterr().err
    assert cli.main(["bench", "recall", "--seconds", "0"]) == cli.EXIT_BAD_INPUT


def test_a_row_reads_the_same_after_it_was_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0.249 s is 0.2 s, and so it stays: not 0.25 s in the file and 0.3 s when it is read."""
    out, passed = tmp_path / "r.csv", iter([0.0, 0.249])
    monkeypatch.setattr(recall.time, "process_time", lambda: next(passed))
    options = recall.Options(memories=("gdn",), delays=(1,), hidden_size=8, seconds=0.2, out=out)
    ((_, row),) = recall.run(options, print)
    assert [found._asdict() for found in read_rows(out, Recall)] == [row] and row["seconds"] == 0.25


def test_the_table_says_what_was_not_solved() -> None:
    rows = [
        Recall("lru", 8, 64, 0, 0.995, 2000, 50, 0.3, 100, 128),
        Recall("mlp", 8, 64, 0, 0.25, 2000, 900, 120.0, 90, 0),
        Recall("lru", 32, 64, 0, 1.0, 2000, 75, 1.6, 100, 128),
    ]
    assert recall.markdown(rows).splitlines()[2:] == [
        "| `lru` | 99.5 % (50 steps, 0.3 s) | 100.0 % (75 steps, 1.6 s) | 100 | 128 |",
        "| `mlp` | 25.0 % (not solved: 900 steps, 120 s) |  | 90 | 0 |",
    ]
