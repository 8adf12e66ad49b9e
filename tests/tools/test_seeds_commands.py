"""``arcade-torch train --seeds`` and ``arcade-torch bench seeds``."""

import csv
from pathlib import Path

import pytest

from arcade_torch.agents import load
from arcade_torch.tools import cli
from arcade_torch.tools.bench import seeds as bench

SMOKE = ["train", "--preset", "smoke", "--env", "CartPoleEasy", "--total-frames", "128"]


def test_seeds_are_trained_into_folders_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*SMOKE, "--seeds", "4", "1", "--out", str(tmp_path / "two")]
    assert cli.main(words) == cli.EXIT_OK
    for seed in (4, 1):
        agent = load(tmp_path / "two" / f"seed{seed}")
        assert (agent.config.seed, agent.frames) == (seed, 128)
    said = capsys.readouterr()
    assert [line for line in said.out.splitlines() if line.startswith("finished: ")] == [
        f"finished: {tmp_path / 'two' / f'seed{seed}'}" for seed in (4, 1)
    ]
    assert "256 of 256 frames" in said.err
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    assert "is not empty; pass resume=True" in capsys.readouterr().err
    assert cli.main([*words, "--resume"]) == cli.EXIT_OK


def test_without_a_folder_they_go_where_runs_alone_would() -> None:
    from arcade_torch.tools.commands.train import parse

    several, alone = parse([*SMOKE[1:], "--seeds", "4"], "train"), parse([*SMOKE[1:], "--seed", "4"], "train")
    assert several.folder(4) == alone.folder()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--seeds", "1", "1"], "seeds must be all different; got [1, 1]"),
        (["--seed", "1", "--seeds", "2", "3"], "give --seed for one run or --seeds for several, not both"),
        (["--seeds", "1", "2", "--algorithm", "dqn"], "algorithm must be 'pqn' for several seeds in one process"),
        (["--seeds", "1", "-2"], "seed must be in [0, 1073741824); got -2"),
    ],
)
def test_seeds_that_cannot_be_trained_get_one_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*SMOKE, *words, "--out", str(tmp_path / "none")]) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1 and not (tmp_path / "none").exists()


def test_the_benchmark_compares_with_runs_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    full = bench.preset
    monkeypatch.setattr(bench, "preset", lambda name, **changes: full("smoke", **changes))
    file = tmp_path / "seeds.csv"
    words = ["--seeds", "1", "2", "--memories", "mlp", "--env", "CartPoleEasy", "--seconds", "0.01", "--repeats", "1"]
    assert cli.main(["bench", "seeds", *words, "--out", str(file)]) == cli.EXIT_OK
    with file.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["seeds"] for row in rows] == ["1", "2"] and rows[0]["alone_fps"] == rows[1]["alone_fps"]
    for row in rows:
        assert float(row["gain"]) == pytest.approx(float(row["together_fps"]) / float(row["alone_fps"])) != 0
    assert "frames/s one by one" in capsys.readouterr().out
    assert cli.main(["bench", "seeds", "--seeds", "0"]) == cli.EXIT_BAD_INPUT
    assert "the numbers of seeds must be 1 or more, got [0]" in capsys.readouterr().err
