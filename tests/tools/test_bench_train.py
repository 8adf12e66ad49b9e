"""The training benchmark: shares add up, arithmetic is counted right, and nothing of the trainer is left changed."""

import csv
import time
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from arcade_torch.agents import trainer
from arcade_torch.models import PaperEncoder, SmallEncoder
from arcade_torch.tools import cli
from arcade_torch.tools.bench import train as bench
from arcade_torch.tools.bench.convolutions import convolutions_of, plain_pass
from arcade_torch.tools.bench.laps import Laps


@pytest.mark.parametrize("encoder", [PaperEncoder(128), SmallEncoder(128)], ids=["paper", "small"])
def test_the_arithmetic_of_the_convolutions_is_what_torch_counts(encoder: nn.Module) -> None:
    frames = torch.zeros(2, 128, 128, 3, dtype=torch.uint8)
    shapes = convolutions_of(encoder, frames)
    with FlopCounterMode(display=False) as counter:
        encoder(frames).sum().backward()
    counted = counter.get_flop_counts()["Global"]
    convolutions = sum(number for op, number in counted.items() if "convolution" in str(op))
    assert sum(shape.flops for shape in shapes) == convolutions
    with FlopCounterMode(display=False) as counter:
        seconds = plain_pass(shapes)()
    assert seconds > 0 and counter.get_total_flops() == convolutions


class Owner:
    def work(self) -> int:
        return 7


def test_laps_give_every_moment_to_the_part_that_was_at_work() -> None:
    class Slow(nn.Linear):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            time.sleep(0.05)
            y: torch.Tensor = super().forward(x)
            y.register_hook(lambda gradient: time.sleep(0.1))  # ahead of the stopwatch's: belongs to what lies behind
            return y

    first, second, laps = nn.Linear(3, 4), Slow(4, 2), Laps()
    with laps.through(first, "first", "before", "between"), laps.through(second, "second", "between", "behind"):
        outer = time.perf_counter()
        laps.start()
        inner = time.perf_counter()
        second(first(torch.randn(5, 3))).sum().backward()
        at_least = time.perf_counter() - inner
        laps.press("after")
        at_most = time.perf_counter() - outer
    assert list(laps.seconds) == ["before", "first", "between", "second", "behind", "after"]
    assert laps.seconds["second"] >= 0.05 and laps.seconds["behind"] >= 0.1
    assert at_least <= sum(laps.seconds.values()) + 1e-9 <= at_most + 2e-9  # nothing is lost, nothing counted twice
    before = dict(laps.seconds)
    second(first(torch.randn(5, 3))).sum().backward()
    assert laps.seconds == before  # the hooks are gone
    owner = Owner()
    with laps.around(owner, "work", "inside", "before"):
        assert owner.work() == 7 and "inside" in laps.seconds
    assert not owner.__dict__


def test_the_benchmark_times_whole_parts_and_its_table_is_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    smoke = bench.preset("smoke")
    monkeypatch.setattr(
        bench, "preset", lambda name, **changes: bench.dataclasses.replace(smoke, **{**changes, "network": "small"})
    )
    file = tmp_path / "speed.csv"
    monkeypatch.setattr(trainer, "COMPILE_BACKEND", "eager")
    words = ["--networks", "small", "--memories", "gru", "--env", "SignpostEasy", "--grad-steps", "2", "--repeats", "1"]
    words += ["--forms", "amp", "compiled+amp"]
    assert cli.main(["bench", "train", *words, "--note", "loaded machine", "--out", str(file)]) == cli.EXIT_OK
    with file.open(newline="") as stream:
        row, compiled = csv.DictReader(stream)
    assert (row["form"], compiled["form"]) == ("amp", "compiled+amp")
    assert float(compiled["train_fps"]) > 0 and compiled["encoder_gflops"] == compiled["learning: memory"] == ""
    assert (row["memory"], row["num_envs"], row["grad_steps"], row["note"]) == ("gru", "8", "8", "loaded machine")
    for group in ("collecting", "learning", "kinds"):
        shares = [float(value) for key, value in row.items() if key.startswith(f"{group}: ")]
        assert len(shares) >= 6 and sum(shares) == pytest.approx(1)
    for part in ("learning: encoder", "learning: memory", "collecting: environment", "kinds: convolutions"):
        assert float(row[part]) > 0, part
    both = 1 / float(row["collect_fps"]) + 1 / float(row["learn_fps"])
    assert float(row["train_fps"]) == pytest.approx(1 / both)
    shown = capsys.readouterr().out
    assert "small, gru, amp" in shown and "frames/s both" in shown and "torch_threads" in shown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "x.txt"], "must end in .csv or .json"),
        (["--grad-steps", "0"], "grad_steps must be at least 1, got 0"),
        (["--networks", "tiny"], "unknown preset 'tiny'"),
        (["--threads", "-1"], "--threads must be 0 or more"),
        (["--forms", "amp+fast"], "a form is eager, amp, compiled, graphs, or several of them joined by '+'; got"),
        (["--forms", "graphs"], "cuda_graphs must be false on device 'cpu'; it needs a CUDA device"),
    ],
)
def test_wrong_options_get_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "train", *words]) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
