"""``arcade-torch figure throughput``: from the file of ``bench envs`` to two panels and their
numbers.
"""

from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli
from arcade_torch.tools.files import write_csv

RATES = {
    "step+draw": 100.0,
    "step": 1000.0,
    "env": 60.0,
    "collector": 80.0,
    "fill": 5000.0,
    "copy": 4000.0,
}


def write_bench(path: Path, **changes: Any) -> Path:
    """A file as ``bench envs`` writes it: two games, two batch sizes, the second game twice as
    fast.
    """
    rows = [
        {"game": game, "obs_size": 128, "num_envs": count, "measure": name, "frames": 10}
        | {
            "frames_per_s": 2 * rate * times * count,
            "frames_per_s_with_check": rate * times * count,
        }
        | changes
        for times, game in ((1, "AEasy"), (2, "BEasy"))
        for count in (1, 16)
        for name, rate in RATES.items()
    ]
    return write_csv(path, rows, list(rows[0]))


def figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> list[dict[str, str]]:
    assert (
        cli.main(
            ["figure", "throughput", "--runs", str(tmp_path / "b.csv"), "--out", str(tmp_path)]
        )
        == cli.EXIT_OK
    )
    capsys.readouterr()
    return read_csv(tmp_path / "throughput.csv")


def rate(rows: list[dict[str, str]], series: str, kind: str, envs: int) -> float:
    key = (series, kind, str(envs))
    return next(
        float(row["frames_per_s"])
        for row in rows
        if (row["series"], row["kind"], row["num_envs"]) == key
    )


def test_rates_are_those_with_every_frame_consumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bench(tmp_path / "b.csv")
    rows = figure(tmp_path, capsys)
    assert (tmp_path / "throughput.png").read_bytes().startswith(b"\x89PNG")
    assert (
        rate(rows, "BEasy", "drawing", 16) == 3200
        and rate(rows, "BEasy", "no drawing", 16) == 32000
    )
    assert rate(rows, "compiled step", "mean", 1) == 150
    assert rate(rows, "writing the same bytes", "mean", 16) == 120_000


def test_what_is_no_benchmark_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bench(tmp_path / "b.csv")
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    write_bench(tmp_path / "e.csv", measure="fill")
    write_bench(tmp_path / "n.csv", num_envs=0)
    wrong = {
        "--runs must be one file of `arcade-torch bench envs --out FILE.csv`": [],
        "b.csv does not exist": ["--runs", str(tmp_path / "nowhere" / "b.csv")],
        "x.csv is no table with columns game, measure": ["--runs", str(tmp_path / "x.csv")],
        "e.csv has no row with the measure step+draw": ["--runs", str(tmp_path / "e.csv")],
        "num_envs and rates must be numbers above 0": ["--runs", str(tmp_path / "n.csv")],
        "Unrecognized options: --paper": ["--paper"],
    }
    for message, words in wrong.items():
        assert (
            cli.main(["figure", "throughput", "--out", str(tmp_path / "f"), *words])
            == cli.EXIT_BAD_INPUT
        )
        err = capsys.readouterr().err
        assert message in err and err.count("\n") == 1, err
