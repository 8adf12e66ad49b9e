"""The training benchmark: rates fit together, shares add up, and wrong options get one line."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import trainer
from arcade_torch.agents.learner import Learner
from arcade_torch.tools import cli
from arcade_torch.tools.bench import train as bench
from arcade_torch.tools.bench.train import KINDS, REST, op_breakdown


def test_the_benchmark_times_whole_parts_and_its_table_is_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    smoke = bench.preset("smoke")
    monkeypatch.setattr(
        bench,
        "preset",
        lambda name, **changes: bench.dataclasses.replace(smoke, **{**changes, "network": "small"}),
    )
    file, step, steps = tmp_path / "speed.csv", Learner.gradient_step, list[float]()
    monkeypatch.setattr(
        Learner,
        "gradient_step",
        lambda self, rows, frames: (steps.append(frames), step(self, rows, frames)),
    )
    monkeypatch.setattr(trainer, "COMPILE_BACKEND", "eager")
    words = [
        "--networks",
        "small",
        "--memories",
        "gru",
        "--env",
        "SignpostEasy",
        "--grad-steps",
        "6",
        "--repeats",
        "1",
    ]
    words += ["--forms", "amp", "compiled+amp"]
    assert cli.main(["bench", "train", *words, "--out", str(file)]) == cli.EXIT_OK
    with file.open(newline="") as stream:
        row, compiled = csv.DictReader(stream)
    assert (row["form"], compiled["form"]) == ("amp", "compiled+amp")
    assert float(compiled["train_fps"]) > 0
    assert (
        len(steps) == 2 * 4 * 6
    )  # a warm-up, the timed pass and two of the profiler; an epoch has four steps
    assert (row["memory"], row["num_envs"], row["grad_steps"], row["device"]) == (
        "gru",
        "8",
        "8",
        "cpu",
    )
    shares = [float(value) for key, value in row.items() if key.startswith("learning: ")]
    assert len(shares) >= 6 and sum(shares) == pytest.approx(1, abs=1e-2)
    assert float(row["learning: convolutions"]) > 0
    both = 1 / float(row["collect_fps"]) + 1 / float(row["learn_fps"])
    assert float(row["train_fps"]) == pytest.approx(1 / both, rel=1e-2)
    assert row["threads"] == str(torch.get_num_threads()), "--threads 0 leaves the setting alone"
    shown = capsys.readouterr().out
    assert "train_fps" in shown and "threads" in shown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "x.txt"], "must be a file that ends in .csv or .json"),
        (["--grad-steps", "0"], "--grad-steps must be at least 1, got 0"),
        (["--networks", "tiny"], "unknown preset 'tiny'"),
        (
            ["--networks", "small", "--grad-steps", "33"],
            "--grad-steps must be at most 32 with the small network; got 33",
        ),
        (["--threads", "-1"], "--threads must be at least 0"),
        (
            ["--forms", "amp+fast"],
            "a form must be eager, amp, compiled, graphs, or several of them joined by '+'; got",
        ),
        (
            ["--forms", "graphs"],
            "cuda_graphs must be false on device 'cpu'; it needs a CUDA device",
        ),
    ],
)
def test_wrong_options_get_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "train", *words]) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def test_kinds_of_operation_share_the_time_of_the_work() -> None:
    x, weight = (
        torch.rand(4, 8, 32, 32, requires_grad=True),
        torch.rand(8, 8, 3, 3, requires_grad=True),
    )
    shares = op_breakdown(lambda: torch.nn.functional.conv2d(x, weight).square().sum().backward())
    assert set(shares) == {*KINDS, REST} and sum(shares.values()) == pytest.approx(1)
    assert shares["convolutions"] > 0.2 and shares["recurrence"] == 0


def test_the_profiler_writes_no_lines_of_its_own() -> None:
    """Before: USDT:... SyncActivityProfilerHandler.cpp:52] profiler_start, among ours."""
    source = (
        "import torch; from arcade_torch.tools.bench.train import op_breakdown\n"
        "print(sum(op_breakdown(lambda: torch.ones(9) + 1).values()))"
    )
    ran = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True)
    assert float(ran.stdout) == pytest.approx(1)
    assert "Profiler" not in ran.stderr  # torch itself may say there that it finds no GPU
