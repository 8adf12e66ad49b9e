"""The table of baselines, and the sheet of all games."""

from pathlib import Path

import numpy as np
import pytest

from arcade_torch.agents.metrics import student_half_width
from arcade_torch.envs_jax import make
from arcade_torch.tools import cli, players
from arcade_torch.tools.play.recording import scene, sheet


def test_a_row_holds_mean_interval_and_length() -> None:
    row = players.measure("SignpostEasy", "random", episodes=500, seconds=60)
    assert (row.id, row.player, row.episodes, row.steps) == ("SignpostEasy-v0", "random", 500, 5)
    # Five steps, four of which cost 1/4 with chance 4/5, one of which pays 1 with chance 1/5.
    assert row.half_width == pytest.approx(1.96 * np.sqrt((4 * 0.16 / 16 + 0.16) / 500), rel=0.1)
    assert abs(row.mean + 0.6) < 2.5 * row.half_width


def test_time_ends_the_measurement_after_a_whole_block() -> None:
    assert players.measure("SignpostEasy", "state", episodes=1000, seconds=0).episodes == 250


def test_rows_that_are_there_are_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "b.csv"
    rows = list(players.measure_all(["SignpostEasy-v0"], 8, 60, out))
    monkeypatch.setattr(players, "measure", None)
    again = list(players.measure_all(["SignpostEasy-v0"], 8, 60, out))
    assert [row.player for row in again] == list(players.PLAYERS)
    assert [row.mean for row in again] == pytest.approx([row.mean for row in rows], abs=1e-5)


def test_the_table_is_written_between_the_marks_of_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{players.BEGIN}old{players.END}\nafter\n")
    words = [
        "list",
        "baselines",
        "SignpostEasy",
        "--episodes",
        "8",
        "--out",
        str(tmp_path / "b.csv"),
        "--page",
        str(page),
    ]
    assert cli.main(words) == 0
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
    assert "| 1.000 ± 0.000 | 1.000 ± 0.000 | 1 | 5, 5, 5 | 8 |" in text

    page.write_text("no marks")
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    assert "needs one line '<!-- baselines -->'" in capsys.readouterr().err
    assert page.read_text() == "no marks"


def test_a_game_without_oracles_has_the_random_player_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(make("SignpostEasy")), "oracles", {"state": "x:X"})
    assert players.players_of("SignpostEasy") == ["random", "state"]
    monkeypatch.setattr(type(make("SignpostEasy")), "oracles", {})
    rows = list(players.measure_all(["SignpostEasy-v0"], 8, 60, tmp_path / "b.csv"))
    assert [row.player for row in rows] == ["random"] and players.markdown(rows).count(
        "SignpostEasy"
    ) == 1


def test_a_file_of_something_else_is_refused_and_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "b.csv"
    out.write_text("a,b\n1,2\n")
    assert cli.main(["list", "baselines", "SignpostEasy", "--out", str(out)]) == cli.EXIT_BAD_INPUT
    assert "is no table with columns id, player" in capsys.readouterr().err
    assert out.read_text() == "a,b\n1,2\n"


def test_a_scene_shows_the_same_moment_to_both_twins() -> None:
    full, partial = scene("SignpostEasy", 128, steps=60)
    changed = (full != partial).any(-1)
    assert changed.any()
    rows, columns = np.nonzero(changed)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) >= (32, 32, 48, 48)
    assert max(rows.max() - 64, columns.max() - 80) < 0  # nothing but the sign


def test_a_sheet_has_a_place_for_every_frame() -> None:
    assert sheet(["SignpostEasy"], columns=2).shape == (
        24 + 264,
        2 * (2 * 256 + 2 * 128 + 4 * 8),
        3,
    )


def test_few_episodes_have_students_interval_and_one_has_none() -> None:
    few = players.measure("SignpostEasy", "random", episodes=3)
    one = players.measure("SignpostEasy", "random", episodes=1)
    returns = [0.25, 0.5, 1.0]
    spread = float(np.std(returns, ddof=1))
    assert student_half_width(returns) == pytest.approx(
        4.302653 * spread / np.sqrt(3)
    )  # 1.96 for very many
    assert student_half_width(np.zeros(10**5) + np.arange(10**5) % 2) == pytest.approx(
        1.96 * 0.5 / 10**2.5, rel=1e-3
    )
    assert np.isnan(student_half_width([0.5])) and np.isnan(student_half_width([]))
    assert np.isnan(one.half_width) and not np.isnan(few.half_width)
    page = players.markdown([one])
    assert f"| {one.mean:.3f} |" in page and "nan" not in page and "±" not in page
