"""An entry without checkpoints is trained again from its settings, and gives the same bits."""

import json
import shutil
from pathlib import Path

import pytest

from arcade_torch.agents.presets import preset
from arcade_torch.agents.training import train
from arcade_torch.tools.board import check as checks
from arcade_torch.tools.board.check import check
from arcade_torch.tools.board.entry import EntryRefusedError
from tests.tools.board.boards import SHORT, plain_entry


def train_twins(folder: Path) -> None:
    """A run of a few frames on each twin."""
    for twin in ("full", "partial"):
        config = preset("smoke", env="CartPoleEasy-v0", observability=twin, seed=3, threads=1)
        train(config, folder / twin)


def test_a_run_that_is_trained_again_from_its_entry_has_the_same_weights_and_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_twins(tmp_path / "first")
    file = tmp_path / "entry.json"
    plain = plain_entry(tmp_path / "first")
    file.write_text(json.dumps(plain))
    record = check(file, tmp_path / "second", protocol=SHORT, weights="retrained")
    assert (record.runs, record.equal, record.weights) == (2, 2, "retrained")

    monkeypatch.setattr(checks, "MOST_FRAMES_AGAIN", 100)
    with pytest.raises(EntryRefusedError, match="are not trained again, at most 100"):
        check(file, tmp_path / "third", protocol=SHORT, weights="retrained")


def test_runs_that_lie_there_under_any_name_are_not_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_twins(tmp_path / "runs")
    file = tmp_path / "entry.json"
    file.write_text(json.dumps(plain_entry(tmp_path / "runs")))
    trained = []
    monkeypatch.setattr(
        "arcade_torch.agents.training.train",
        lambda config, out, resume: trained.append(train(config, out, resume=resume)),
    )
    assert check(file, tmp_path / "runs", protocol=SHORT, weights="retrained").equal == 2
    assert not trained
    # one of them stopped before its end
    shutil.rmtree(max(tmp_path.glob("runs/full/checkpoints/frames-*")))
    assert check(file, tmp_path / "runs", protocol=SHORT, weights="retrained").equal == 2
    assert len(trained) == 1


def test_a_run_that_is_trained_elsewhere_is_compared_by_its_score_and_decides_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_twins(tmp_path / "runs")
    plain = plain_entry(tmp_path / "runs")
    plain["made_with"] |= {"commit": "0123456789ab", "processor": "another one"}
    for run in plain["runs"]:
        run["weights_sha256"] = "0" * 64
    plain["runs"][1]["score"] += 0.25
    file = tmp_path / "entry.json"
    file.write_text(json.dumps(plain))
    says = (
        r"^trained again here, 2 of 2 runs have other weights .* commit 0123456789ab on another one"
        r".* differ by 0.1250 on average, at most by 0.2500.* neither confirms nor refutes"
    )
    with pytest.raises(EntryRefusedError, match=says):
        check(file, tmp_path / "runs", protocol=SHORT, weights="retrained")
    # whoever gives checkpoints gives those of the entry
    others = r"^checkpoint of .* the entry says 0000000000000000"
    with pytest.raises(EntryRefusedError, match=others):
        check(file, tmp_path / "runs", protocol=SHORT, weights="kept")

    now = checks.made_with() | {"commit": "0123456789ab"}
    monkeypatch.setattr(checks, "made_with", lambda: now)
    plain["made_with"] = now
    file.write_text(json.dumps(plain))
    with pytest.raises(EntryRefusedError, match=others):
        check(file, tmp_path / "runs", protocol=SHORT, weights="retrained")
