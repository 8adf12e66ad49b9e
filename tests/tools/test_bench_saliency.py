"""The saliency benchmark: every way makes the same maps, and the two stages stay within their chunk."""

import csv
from pathlib import Path

import pytest

from arcade_torch.tools import cli


def test_all_ways_agree_and_the_two_stages_hold_one_chunk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--networks", "paper", "small", "--steps", "24", "--chunk", "2", "--repeats", "1"]
    assert cli.main(["bench", "saliency", *words, "--out", str(tmp_path / "s.csv")]) == 0
    rows = list(csv.DictReader((tmp_path / "s.csv").open()))
    assert [row["network"] for row in rows] == ["paper"] * 4 + ["small"] * 4
    assert all(float(row["difference"]) < 1e-5 and float(row["seconds"]) > 0 for row in rows)
    for ours, *others in (rows[:4], rows[4:]):
        assert float(ours["ratio"]) == 1
        assert all(float(ours["peak_mib"]) < float(other["peak_mib"]) / 2 for other in others)
    assert "two stages, 2 frames at once" in capsys.readouterr().out


def test_no_network_and_no_frames_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "saliency", "--steps", "0"]) == cli.EXIT_BAD_INPUT
    assert "at least 1" in capsys.readouterr().err
