"""The mean in an ``eval.json`` is that of its returns, and ``config.json`` what was trained, or the
files are not believed.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.agents.evaluation import EvalResult
from arcade_torch.agents.runs.final import is_final, wrong_mean
from arcade_torch.agents.runs.folder import RunFolder
from arcade_torch.tools import cli
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.runs import Run
from arcade_torch.tools.sharing import share as sharing
from tests.tools.board.boards import write_run as write_board_run
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
    for nothing in (float("nan"), float("inf")):
        assert not is_final({"mean": 0.5, "returns": [nothing]})


@pytest.mark.filterwarnings("ignore:.*(overflow|invalid value) encountered:RuntimeWarning")
@pytest.mark.parametrize("returns", [[np.inf], [-np.inf, 1], [np.inf, -np.inf], [1e30, 2e30]])
def test_an_infinite_evaluation_is_one_and_is_not_made_again(
    returns: list[float], tmp_path: Path
) -> None:
    result = EvalResult(np.array(returns, np.float32), np.ones(len(returns), np.int64))
    folder = write_study(tmp_path / "s", small_study())
    path = folder.run(small_study().runs()[0]).path
    values = {
        "mean": result.mean,
        "std": result.std,
        "ci": result.half_width,
        "returns": result.returns.tolist(),
        "lengths": result.lengths.tolist(),
    }
    file = path / "eval.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | values))
    assert RunFolder(path).finished() is not None
    row = folder.write_results(small_study())[0]
    assert row["status"] == "finished"
    assert math.isfinite(row["eval_mean"]) == (returns[0] == 1e30)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"memory": "lru"}, "memory ('lru' != 'mingru')"),
        ({"observability": "partial"}, "observability ('partial' != 'full')"),
        ({"network_options": {"layers": 2}}, "network_options.layers (2 != None)"),
        ({"algorithm": ["pqn"]}, "algorithm (['pqn'] != 'pqn')"),
        ({"device": "cuda", "threads": 4, "eval_episodes": 7}, None),
    ],
)
def test_settings_that_were_changed_after_the_training_are_refused(
    settings: dict[str, Any], message: str | None, tmp_path: Path
) -> None:
    run = write_board_run(tmp_path)
    record = json.loads((run / "config.json").read_text())
    record["config"] |= settings
    (run / "config.json").write_text(json.dumps(record))
    if message is None:
        assert len(find_runs([tmp_path]).runs) == 1
        return
    with pytest.raises(ValueError, match=r"config.json was changed since the training") as refusal:
        find_runs([tmp_path])
    assert message in str(refusal.value)


def test_a_checkpoint_that_cannot_be_read_says_nothing_of_the_settings(tmp_path: Path) -> None:
    run = write_board_run(tmp_path)
    for content in ("", "[]", '{"config": 3}', '{"config": {"pqn": 3}}'):
        for file in run.glob("checkpoints/*/meta.json"):
            file.write_text(content)
        assert len(find_runs([tmp_path]).runs) == 1, content


def test_a_training_score_that_is_not_that_of_the_curve_is_refused(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "s", small_study())
    path = folder.run(small_study().runs()[0]).path
    (path / "metrics.csv").write_text("frames,train_return_last\n64,0.25\n128,0.25\n")
    final = json.loads((path / "eval.json").read_text())
    (path / "eval.json").write_text(json.dumps(final | {"train_max_ewm": 0.25}))
    assert Run(path).value("train_max_ewm") == 0.25
    (path / "eval.json").write_text(json.dumps(final | {"train_max_ewm": 0.9}))
    with pytest.raises(ValueError, match=r"its train_max_ewm is 0\.9, that of the curve 0\.25"):
        Run(path).value("train_max_ewm")
    assert Run(path).value("eval_final") == final["mean"]


def test_a_run_whose_command_and_versions_were_changed_can_be_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_board_run(tmp_path)
    record = json.loads((run / "config.json").read_text()) | {"command": {"a": 1}, "versions": [1]}
    (run / "config.json").write_text(json.dumps(record))
    one = EvalResult(np.zeros(1, np.float32), np.ones(1, np.int64))
    monkeypatch.setattr(sharing, "_evaluated", lambda *arguments: one)
    results = sharing.share(run, tmp_path / "shared", "", 1, False, False)
    assert results["training"] == {"versions": {}, "command": ""}
