"""The saliency benchmark: every way makes the same maps, and the two stages stay within their chunk."""

import csv
from pathlib import Path

import pytest
import torch

from arcade_torch.models.encoders import PaperEncoder, SmallEncoder
from arcade_torch.tools import cli
from arcade_torch.tools.bench.saliency import written_out


def test_all_ways_agree_and_the_two_stages_hold_one_chunk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--networks", "paper", "small", "--steps", "24", "--chunk", "2", "--repeats", "1"]
    assert cli.main(["bench", "saliency", *words, "--out", str(tmp_path / "s.csv")]) == 0
    rows = list(csv.DictReader((tmp_path / "s.csv").open()))
    assert [row["network"] for row in rows] == ["paper"] * 7 + ["small"] * 4
    assert all(float(row["difference"]) < 1e-5 and float(row["seconds"]) > 0 for row in rows)
    for ours, *others in (rows[:7], rows[7:]):
        assert float(ours["ratio"]) == 1
        assert all(float(ours["peak_mib"]) < float(other["peak_mib"]) / 2 for other in others)
    assert "two stages, 2 frames at once" in capsys.readouterr().out


def test_the_table_written_out_computes_what_our_encoder_computes() -> None:
    encoder, frames = PaperEncoder(), torch.rand(2, 128, 128, 3) * 255
    table = written_out(encoder)
    assert table is not None
    assert torch.allclose(table(frames), encoder(frames), atol=1e-5)
    assert encoder.layers[0].weight.is_contiguous(memory_format=torch.channels_last)  # left as it was
    assert written_out(SmallEncoder()) is None


def test_no_network_and_no_frames_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "saliency", "--steps", "0"]) == cli.EXIT_BAD_INPUT
    assert "at least 1" in capsys.readouterr().err
