"""A run that stopped exploring before it learned says so; others do not."""

import csv
import math
from pathlib import Path

import pytest

from arcade_torch.agents import preset
from arcade_torch.agents.training import train
from arcade_torch.tools.cli import main
from arcade_torch.tools.exploring import stopped_exploring
from arcade_torch.tools.reports import report
from arcade_torch.tools.runs import Run
from tests.tools.fabricated import small_study, write_run, write_study

UNIFORM = math.log(5)


def write_metrics(path: Path, returns: list[float], entropies: list[float | None]) -> None:
    """``metrics.csv`` of a run that began with the first return and entropy and ended with the
    last.
    """
    rows = []
    for step in range(100):
        place = min(1, max(0, (step - 2) / 95)) * (len(returns) - 1)
        before, share = int(place), place % 1
        after = min(before + 1, len(returns) - 1)
        value = returns[before] * (1 - share) + returns[after] * share
        entropy = entropies[round(step / 99 * (len(entropies) - 1))]
        rows.append({"frames": step, "train_return": value, "entropy": entropy})
    with open(path / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ["frames", "train_return", "entropy"])
        writer.writeheader()
        writer.writerows(rows)


def navigator(tmp_path: Path, game: str = "NavigatorEasy") -> Path:
    study = small_study(games=[game])
    write_run(tmp_path / "run", study.runs()[0], -0.5)
    return tmp_path / "run"


@pytest.mark.parametrize(
    ("returns", "entropies", "stopped"),
    [
        ([-0.55, -0.5], [UNIFORM, 0.01], True),  # walks until the time is over, and is sure of it
        ([-0.55, -0.5], [UNIFORM, 0.9], False),  # still explores
        ([-0.55, 0.9], [UNIFORM, 0.01], False),  # has learned
        ([-0.55, 0.4, -0.5], [UNIFORM, 0.01], True),  # had learned, and gave it up
        ([-0.55, -0.5], [None], False),  # no entropy: PQN or DQN
    ],
)
def test_it_is_said_of_certain_policies_that_have_learned_nothing(
    tmp_path: Path, returns: list[float], entropies: list[float | None], stopped: bool
) -> None:
    folder = navigator(tmp_path)
    write_metrics(folder, returns, entropies)
    line = stopped_exploring(Run(folder))
    assert bool(line) == stopped
    if stopped:
        assert "\n" not in line and f"{returns[0]:.3f}" in line and f"{returns[-1]:.3f}" in line


def test_runs_without_metrics_or_of_unknown_games_are_left_alone(tmp_path: Path) -> None:
    folder = navigator(tmp_path)
    (folder / "metrics.csv").unlink()
    assert stopped_exploring(Run(folder)) == ""
    write_metrics(folder, [-0.55, -0.5], [UNIFORM, 0.01])
    assert stopped_exploring(Run(folder, game_name="NoSuchGame-v0")) == ""


def test_the_report_names_such_runs(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "study", small_study())
    skipped = ("references", "saliency", "recall", "counterfactual", "beliefs", "contamination")
    first = folder.run(small_study().runs()[0]).path
    write_metrics(first, [0.0, 0.01], [UNIFORM, 0.01])
    page = report(tmp_path / "study", tmp_path / "page.html", skip=skipped).read_text()
    lines = [line for line in page.splitlines() if "stopped exploring" in line]
    assert len(lines) == 1 and first.name in lines[0]


def test_train_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = preset("smoke", env="SignpostEasy", algorithm="ppo", total_frames=128)
    train(config, tmp_path / "run")
    write_metrics(tmp_path / "run", [-0.6, -0.6], [UNIFORM, 0.01])
    words = ["--preset", "smoke", "--env", "SignpostEasy", "--algorithm", "ppo"]
    words += ["--total-frames", "128", "--out", str(tmp_path / "run"), "--resume"]
    assert main(["train", *words]) == 0
    assert "this run stopped exploring before it learned" in capsys.readouterr().out
