"""From a TOML file to a report, with trainings too short to learn anything."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli, machine, players
from arcade_torch.tools.bench.envs import read_all
from arcade_torch.tools.studies.folder import StudyFolder

ROOT = Path(__file__).resolve().parents[2]
TOML = """
games = ["MineSweeperEasy"]
memories = ["mlp"]
seeds = 1
preset = "smoke"
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two runs, trained in this process."""
    root = tmp_path_factory.mktemp("study")
    (root / "toy.toml").write_text(TOML)
    words = [
        "study",
        str(root / "toy.toml"),
        "--out",
        str(root / "out"),
        "--engine",
        "inline",
        "--no-report",
    ]
    assert cli.main(words) == 0
    return root / "out"


def test_a_study_trains_every_run_and_collects_the_results(finished: Path) -> None:
    rows = read_csv(finished / "results.csv")
    assert [row["status"] for row in rows] == ["finished", "finished"]
    assert [row["observability"] for row in rows] == ["full", "partial"]
    assert all(row["eval_n"] == "4" and row["train_max_ewm"] for row in rows)
    assert all(float(row["seconds"]) > 0 for row in read_csv(finished / "timings.csv"))


def test_a_finished_study_is_not_trained_again(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in (finished / "runs").rglob("*.csv")}
    words = [
        "study",
        str(finished.parent / "toy.toml"),
        "--out",
        str(finished),
        "--engine",
        "inline",
        "--no-report",
    ]
    assert cli.main(words) == 0
    assert "2 of 2 runs finished" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in (finished / "runs").rglob("*.csv")}


def test_a_job_is_a_config_in_json_and_trains_the_same_run(finished: Path, tmp_path: Path) -> None:
    for line in json.loads((finished / "study.json").read_text())["runs"].values():
        words = line.split()[1:]
        assert words[:2] == ["train", "--config"] and words[3:] == ["--out", words[4], "--resume"]
    words[4] = str(tmp_path / "again")
    assert cli.main(words) == 0
    found = [
        json.loads((path / "eval.json").read_text())
        for path in (tmp_path / "again", Path(line.split()[5]))
    ]
    assert (
        found[0]["returns"] == found[1]["returns"]
        and found[0]["train_max_ewm"] == found[1]["train_max_ewm"]
    )


@pytest.mark.parametrize("engine", ["inline", "processes"])
def test_a_run_that_fails_leaves_its_reason_and_a_log(
    engine: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "toy.toml").write_text(TOML + 'observability = "full"')
    run = tmp_path / "out" / "runs" / "MineSweeperEasy__full__mlp__pqn__seed0"
    run.mkdir(parents=True)
    (run / "thesis.tex").write_text("precious")
    (tmp_path / "out" / "study.json").write_text("")
    words = [
        "study",
        str(tmp_path / "toy.toml"),
        "--out",
        str(tmp_path / "out"),
        "--engine",
        engine,
        "--no-report",
    ]
    assert cli.main(words) == 1
    (row,) = read_csv(tmp_path / "out" / "results.csv")
    assert (row["status"], row["error"]) == ("failed", f"{run} is not empty; choose another folder")
    log = tmp_path / "out" / "logs" / f"{run.name}.log"
    assert (
        f"{row['error']} (log: {log})" in capsys.readouterr().out
        and "is not empty" in log.read_text()
    )


def test_an_agent_can_be_evaluated_on_both_twins(
    finished: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run = next((finished / "runs").iterdir())
    words = [
        "evaluate",
        str(run),
        "--episodes",
        "3",
        "--observability",
        "partial",
        "--json",
        str(tmp_path / "e.json"),
    ]
    assert cli.main(words) == 0
    assert "over 3 episodes" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "e.json").read_text())["returns"]) == 3
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    assert "e.json exists" in capsys.readouterr().err


def test_saliency_is_drawn_and_its_numbers_are_kept(finished: Path, tmp_path: Path) -> None:
    run = next((finished / "runs").iterdir())
    assert (
        cli.main(["analyze", "saliency", str(run), "--out", str(tmp_path / "s.png"), "--show", "4"])
        == 0
    )
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")
    with np.load(tmp_path / "s.npz", allow_pickle=False) as kept:
        assert kept["frames_0"].shape[1:] == (128, 128, 3)
        assert kept["maps_0"].shape == kept["frames_0"].shape[:3]
        assert not kept["maps_0"][:-1].any()  # the stateless cell cannot look back


def test_the_report_holds_a_strip_of_every_agent(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    assert cli.main(["report", str(finished), "--out", str(page), "--skip", "references"]) == 0
    text = page.read_text()
    assert text.count("data:image/png;base64,") >= 2
    assert "100.0 % of the gradient on the last one" in text
    folder = StudyFolder(finished)
    assert all(
        list((folder.run(run).path / "analysis").glob("episode_saliency-*.npz"))
        for run in folder.load().runs()
    )


def test_reference_returns_are_computed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = players.references("MineSweeperEasy", tmp_path, episodes=16)
    assert found["random"].mean < found["frames"].mean < found["state"].mean == pytest.approx(1.0)
    monkeypatch.setattr(players, "measure", None)
    assert players.references("MineSweeperEasy", tmp_path, episodes=16) == found


def test_the_benchmark_consumes_every_frame_it_counts(tmp_path: Path) -> None:
    words = ["--games", "MineSweeperEasy", "--batches", "2", "--seconds", "0.01", "--repeats", "2"]
    assert cli.main(["bench", "envs", *words, "--out", str(tmp_path / "b.csv")]) == 0
    rows = {row["measure"]: row for row in read_csv(tmp_path / "b.csv")}
    assert list(rows) == ["step+draw", "step", "env", "collector", "fill", "copy"]
    for name in ("step+draw", "env", "collector"):
        row = {
            key: float(rows[name][key])
            for key in ("frames", "frames_per_s", "frames_per_s_with_check")
        }
        assert row["frames"] >= 4 and row["frames"] % 2 == 0 and int(rows[name]["checksum"]) > 0
        assert 0 < row["frames_per_s_with_check"] < row["frames_per_s"]
        assert float(rows[name]["gb_per_s"]) == pytest.approx(
            row["frames_per_s"] * 49_152 / 1e9, rel=1e-3
        )
    assert float(rows["fill"]["share_of_fill"]) == float(rows["copy"]["share_of_copy"]) == 1
    assert float(rows["step"]["gb_per_s"]) == 0


@pytest.mark.parametrize(("words", "kept"), [([], "no"), (["--keep-memory"], "envs")])
def test_the_benchmark_leaves_the_c_library_as_a_user_has_it_and_says_so(
    words: list[str], kept: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[bool] = []
    monkeypatch.setattr(machine, "keep_freed_memory", lambda: calls.append(True))
    few = ["--games", "SignpostEasy", "--batches", "1", "--seconds", "0.001", "--repeats", "1"]
    assert cli.main(["bench", "envs", *few, *words]) == 0
    assert f"keep_memory {kept}" in capsys.readouterr().out and bool(calls) is bool(words)


def test_the_checksum_reads_every_byte() -> None:
    import torch

    frames = torch.zeros(2, 4, 4, 3, dtype=torch.uint8)
    sums = set()
    for place in range(frames.numel()):
        frames.view(-1)[place] = 1
        sums.add(read_all(frames))
        frames.view(-1)[place] = 0
    assert 0 not in sums


@pytest.mark.slow
def test_ctrl_c_stops_a_study_in_processes_and_the_same_command_finishes_it(tmp_path: Path) -> None:
    (tmp_path / "toy.toml").write_text(
        TOML + "total_frames = 4096\n[settings]\ncheckpoint_every = 64\n"
    )
    words = [
        sys.executable,
        "-m",
        "arcade_torch.tools",
        "study",
        str(tmp_path / "toy.toml"),
        "--out",
    ]
    words += [str(tmp_path / "out"), "--engine", "processes", "--no-report"]
    first = subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("out/runs/*/checkpoints/latest")) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.kill(first.pid, signal.SIGINT)
    _, err = first.communicate(timeout=90)
    assert first.returncode == 130, err
    assert "go on from their checkpoints with: arcade-torch study" in err
    status = [
        json.loads(file.read_text())["status"] for file in tmp_path.glob("out/runs/*/progress.json")
    ]
    assert status and set(status) <= {"interrupted", "finished"}
    second = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False
    )
    assert second.returncode == 0, second.stderr
    assert "2 of 2 runs finished" in second.stdout
