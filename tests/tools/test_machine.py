"""What a result says of the machine that it was made on."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from arcade_torch.tools.machine import machine

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
