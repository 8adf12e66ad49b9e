"""An entry without checkpoints is trained again from its settings, and gives the same bits."""

import json
from pathlib import Path

import pytest

from arcade_torch.agents.presets import preset
from arcade_torch.agents.training import train
from arcade_torch.tools.board import check as checks
from arcade_torch.tools.board.check import check
from arcade_torch.tools.board.entry import EntryRefusedError
from tests.tools.board.boards import SHORT, plain_entry


def test_a_run_that_is_trained_again_from_its_entry_has_the_same_weights_and_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for twin in ("full", "partial"):
        config = preset("smoke", env="CartPoleEasy-v0", observability=twin, seed=3, threads=1)
        train(config, tmp_path / "first" / twin)
    file = tmp_path / "entry.json"
    plain = plain_entry(tmp_path / "first")
    file.write_text(json.dumps(plain))
    record = check(file, tmp_path / "second", protocol=SHORT, weights="retrained")
    assert (record.runs, record.equal, record.weights) == (2, 2, "retrained")

    monkeypatch.setattr(checks, "MOST_FRAMES_AGAIN", 100)
    with pytest.raises(EntryRefusedError, match="are not trained again, at most 100"):
        check(file, tmp_path / "third", protocol=SHORT, weights="retrained")
