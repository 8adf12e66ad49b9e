"""The mean in an ``eval.json`` is that of its returns, or the file is not believed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.agents.evaluation import EvalResult
from arcade_torch.agents.runs.files import is_final, wrong_mean
from arcade_torch.agents.runs.folder import RunFolder
from arcade_torch.tools import cli
from tests.tools.fabricated import small_study, write_study


def change_mean(file: Path, mean: Any) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | {"mean": mean}))


@pytest.mark.parametrize(
    "words", ["figure curves s", "figure returns s", "report s --skip references"]
)
@pytest.mark.parametrize("mean", [0.9, float("nan")])
def test_a_changed_mean_is_refused(
    words: str,
    mean: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = write_study(tmp_path / "s", small_study())
    change_mean(folder.run(small_study().runs()[0]).path / "eval.json", mean)
    assert cli.main(words.split()) == 2
    said = capsys.readouterr().err
    assert f"its mean is {mean:g}, but that of its 2 returns is 0.5" in said
    assert said.count("\n") == 1 and "eval.json was changed" in said


def test_a_run_with_a_changed_mean_is_evaluated_again(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "s", small_study())
    path = folder.run(small_study().runs()[0]).path
    assert RunFolder(path).finished() is not None
    change_mean(path / "eval.json", 0.9)
    assert RunFolder(path).finished() is None
    assert folder.write_results(small_study())[0]["status"] == "unfinished"


def test_the_mean_that_a_training_writes_is_believed() -> None:
    rng = np.random.default_rng(0)
    for size in (1, 7, 4096):
        for scale in (1e-6, 1.0, 1e6):
            returns = (scale * rng.standard_normal(size)).astype(np.float32)
            result = EvalResult(returns, np.ones(size, np.int64))
            values = {"mean": result.mean, "returns": returns.tolist()}
            assert wrong_mean(values) == "" and is_final(values)
    assert is_final({"mean": float("nan"), "returns": [0.5, float("nan")]})
    assert not is_final({"mean": 0.5, "returns": [float("nan")]})
