"""What a result says of the machine that it was made on."""

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arcade_torch.agents import preset, training
from arcade_torch.agents.evaluation import EvalResult
from arcade_torch.models import SmallEncoder
from arcade_torch.tools import cli, exploring
from arcade_torch.tools import machine as machine_module
from arcade_torch.tools.machine import bfloat16_time, machine

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


@pytest.mark.parametrize(("share", "says"), [(1.3, True), (1.01, False), (0.4, False)])
def test_train_says_where_bfloat16_costs_time(
    share: float,
    says: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A Xeon without AMX takes a sixth longer, an EPYC without AMX half the time."""
    monkeypatch.setattr(machine_module, "bfloat16_time", lambda config: share)
    evaluation = EvalResult(np.zeros(1, np.float32), np.ones(1, np.int64))
    stop = SimpleNamespace(evaluation=evaluation, run_dir=tmp_path)
    monkeypatch.setattr(training, "train", lambda *arguments: stop)
    monkeypatch.setattr(exploring, "stopped_exploring", lambda run: None)
    out = str(tmp_path / "run")
    assert cli.main(["train", "--preset", "smoke", "--amp", "--no-check-memory", "--out", out]) == 0
    assert ("--amp costs time here: the encoder" in capsys.readouterr().out) is says


@pytest.mark.parametrize("slow_with_amp", [True, False])
def test_the_time_of_bfloat16_is_measured(
    slow_with_amp: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    features = SmallEncoder.features

    def slow(encoder: SmallEncoder, frames: torch.Tensor) -> torch.Tensor:
        if encoder.amp is slow_with_amp:
            time.sleep(0.1)
        return features(encoder, frames)

    monkeypatch.setattr(SmallEncoder, "features", slow)
    before = torch.random.get_rng_state()
    share = bfloat16_time(preset("small", env="SignpostEasy", amp=True), frames=4)
    assert share > 2 if slow_with_amp else share < 0.5
    assert torch.equal(before, torch.random.get_rng_state())
