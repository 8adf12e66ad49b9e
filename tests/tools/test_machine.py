"""What a result says of the machine that it was made on."""

import platform
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from arcade_torch.agents import training
from arcade_torch.tools import cli, exploring
from arcade_torch.tools.machine import bfloat16_is_slower, machine

NAMES = ("card", "card_memory_gib", "cards", "driver", "torch_cuda")
SMI = """#!/bin/sh
[ "$1" = --query-gpu=driver_version ] || exit 1
echo 580.65.06
echo 580.65.06
"""


def test_a_machine_with_cards_says_which_and_how_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It said ``cuda``, and nothing of the card."""
    card = SimpleNamespace(name="NVIDIA H100 80GB HBM3", total_memory=85_045_870_592)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: card)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setenv("PATH", str(tmp_path))
    without_driver = machine()
    (tmp_path / "nvidia-smi").write_text(SMI)
    (tmp_path / "nvidia-smi").chmod(0o755)
    about = machine()
    values = ("NVIDIA H100 80GB HBM3", "79.2", "2", "580.65.06", "13.0")
    assert tuple(about[name] for name in NAMES) == values
    assert about["torch_device"] == "cuda" and without_driver == about | {
        "driver": "",
        "commit": without_driver["commit"],
    }


@pytest.mark.skipif(torch.cuda.is_available(), reason="here is a card")
def test_a_machine_without_a_card_says_nothing_of_one() -> None:
    about = machine()
    assert [about[name] for name in NAMES[:4]] == ["", "", "", ""]
    assert about["torch_device"] == "cpu" and about["cores"] >= 1


@pytest.mark.parametrize(
    ("processor", "tiles", "slower"),
    [("x86_64", False, True), ("x86_64", True, False), ("arm64", False, False)],
)
def test_train_says_where_bfloat16_costs_time(
    processor: str,
    tiles: bool,
    slower: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A Xeon without AMX took a sixth longer for the frames of a run with --amp, in silence."""
    monkeypatch.setattr(platform, "machine", lambda: processor)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: tiles, raising=False)
    assert bfloat16_is_slower() is slower
    stop = SimpleNamespace(evaluation=SimpleNamespace(mean=0.0, returns=[0.0]), run_dir=tmp_path)
    monkeypatch.setattr(training, "train", lambda *arguments: stop)
    monkeypatch.setattr(exploring, "stopped_exploring", lambda run: None)
    out = str(tmp_path / "run")
    assert cli.main(["train", "--preset", "smoke", "--amp", "--no-check-memory", "--out", out]) == 0
    assert ("--amp costs time here" in capsys.readouterr().out) is slower
