"""TensorBoard and Weights & Biases get the rows of the CSV files, and nothing depends on them."""

import dataclasses
import importlib.util
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from arcade_torch.agents import preset, train
from arcade_torch.agents.runs import loggers
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli
from tests.agents.test_training import assert_same_run, stop_after

CONFIG = preset(
    "smoke", env="SignpostEasy-v0", total_frames=256, eval_every=128, checkpoint_every=128
)
LOGGED = dataclasses.replace(CONFIG, logger="tensorboard")


class Memo:
    """Stands where a logger of TorchRL stands, and keeps what it is given."""

    def __init__(self, fails_at: int = 10**9) -> None:
        self.rows: list[tuple[int, dict[str, float]]] = []
        self.fails_at, self.closed = fails_at, 0
        self.experiment = SimpleNamespace(close=self._close)

    def _close(self) -> None:
        self.closed += 1

    def log_metrics(self, metrics: dict[str, float], step: int) -> None:
        if step >= self.fails_at:
            raise OSError("the disk is full")
        self.rows.append((step, metrics))


@pytest.fixture
def memo(monkeypatch: pytest.MonkeyPatch) -> Memo:
    memo = Memo()
    monkeypatch.setattr(loggers, "check_logger", lambda name: None)
    monkeypatch.setattr("arcade_torch.agents.training.check_logger", lambda name: None)
    monkeypatch.setattr(loggers, "_tensorboard", lambda config, folder, frames: memo)
    return memo


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a logger."""
    folder = tmp_path_factory.mktemp("plain") / "run"
    train(CONFIG, folder)
    return folder


def test_a_logger_gets_every_row_at_its_frame_count_and_changes_no_number(
    plain: Path, tmp_path: Path, memo: Memo
) -> None:
    train(LOGGED, tmp_path / "run")
    assert_same_run(plain, tmp_path / "run")
    learned = [(step, row) for step, row in memo.rows if "train/loss" in row]
    played = [(step, row) for step, row in memo.rows if "eval/mean" in row]
    assert len(learned) + len(played) == len(memo.rows) and memo.closed == 1
    for table, logged in (("metrics.csv", learned), ("eval.csv", played)):
        rows = read_csv(tmp_path / "run" / table)
        assert [step for step, _ in logged] == [int(row["frames"]) for row in rows]
        for (_, metrics), row in zip(logged, rows, strict=True):
            values = {name.split("/")[1]: value for name, value in metrics.items()}
            kept = {name: float(value) for name, value in row.items() if value and name != "frames"}
            assert values == pytest.approx(kept)
    assert {"time/fps", "train/lr", "train/epsilon"} <= learned[0][1].keys()


def test_a_logger_that_fails_ends_and_the_run_does_not(
    plain: Path, tmp_path: Path, memo: Memo
) -> None:
    memo.fails_at = 128
    with pytest.warns(
        UserWarning, match="logging ends here, .*: OSError: the disk is full"
    ) as warned:
        result = train(LOGGED, tmp_path / "run")
    assert result.status == "finished" and len(warned) == 1
    assert_same_run(plain, tmp_path / "run")
    assert memo.rows[-1][0] == 64


def test_a_logger_may_be_changed_when_a_run_goes_on(
    plain: Path, tmp_path: Path, memo: Memo
) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path / "run", progress=stop_after(3, stop))
    assert not memo.rows
    train(LOGGED, tmp_path / "run", resume=True)
    assert_same_run(plain, tmp_path / "run")
    assert [step for step, row in memo.rows if "train/loss" in row] == [192, 256]


def test_a_logger_that_is_not_installed_is_named_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    words = ["--preset", "smoke", "--logger", "wandb", "--out", str(tmp_path / "run")]
    assert cli.main(["train", *words]) == cli.EXIT_BAD_INPUT
    said = (
        "arcade-torch: logger='wandb' needs a package that is missing: pip install '.[loggers]'\n"
    )
    assert capsys.readouterr().err == said
    assert not (tmp_path / "run").exists()


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = accumulator.EventAccumulator(str(folder / "tensorboard")).Reload()
    return {
        tag: [(event.step, event.value) for event in found.Scalars(tag)]
        for tag in found.Tags()["scalars"]
    }


def test_tensorboard_shows_the_rows_and_after_going_on_no_step_twice(
    plain: Path, tmp_path: Path
) -> None:
    pytest.importorskip("tensorboard", reason="needs the loggers extra: pip install '.[loggers]'")

    def stop() -> None:
        raise KeyboardInterrupt

    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train(LOGGED, folder, progress=stop_after(3, stop))  # the last checkpoint is of 128 frames
    train(LOGGED, folder, resume=True)
    assert_same_run(plain, folder)
    shown, rows = scalars(folder), read_csv(folder / "metrics.csv")
    assert [step for step, _ in shown["train/loss"]] == [64, 128, 192, 256]
    assert [value for _, value in shown["train/loss"]] == pytest.approx(
        [float(row["loss"]) for row in rows], rel=1e-6
    )
    assert [step for step, _ in shown["eval/mean"]] == [128, 256]


@pytest.mark.slow
def test_weights_and_biases_keeps_one_offline_run_over_both_parts(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb", reason="needs the loggers extra: pip install '.[loggers]'")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    config, folder = dataclasses.replace(CONFIG, logger="wandb"), tmp_path / "run"

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, folder, progress=stop_after(3, stop))
    id = (folder / "wandb_id.txt").read_text()
    train(config, folder, resume=True)
    assert_same_run(plain, folder)
    assert (folder / "wandb_id.txt").read_text() == id
    parts = list((folder / "wandb").glob("offline-run-*"))
    assert len(parts) == 2 and all(part.name.endswith(id.strip()) for part in parts)
    assert json.loads((folder / "config.json").read_text())["config"]["logger"] == "wandb"
