"""Commands with an agent of several games, and with another game than the agent's."""

from pathlib import Path

import pytest

from arcade_torch.tools import cli
from arcade_torch.tools.exploring import stopped_exploring
from arcade_torch.tools.measures.gap_bias.measure import normalise
from arcade_torch.tools.names import bare_name, game_names
from arcade_torch.tools.runs import Run

MIXTURE = "CartPoleEasy+SkittlesEasy"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run."""
    folder = tmp_path_factory.mktemp("mixture") / "run"
    words = ["train", "--preset", "smoke", "--env", MIXTURE, "--out", str(folder)]
    assert cli.main([*words, "--algorithm", "ppo"]) == 0
    return folder


def test_evaluate_says_what_each_game_gave(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["evaluate", str(run), "--episodes", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("ppo-mingru on CartPoleEasy-v0+SkittlesEasy-v0 (full)")
    assert lines[1].startswith("  CartPoleEasy-v0: mean return ")
    assert lines[2].startswith("  SkittlesEasy-v0: mean return ")

    assert cli.main(["evaluate", str(run), "--episodes", "6", "--game", "SkittlesHard"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("ppo-mingru on SkittlesHard-v0 (full)")


def test_a_measure_asks_for_one_game(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["analyze", "saliency", str(run), "--max-steps", "6", "--out", str(tmp_path), "--csv"]
    assert cli.main(words) == 2
    assert "trained on several games" in capsys.readouterr().err
    for game in ("CartPoleEasy", "SkittlesEasy"):
        assert cli.main([*words, "--game", game]) == 0
        assert f"{game}-v0" in capsys.readouterr().out


def test_agents_of_two_games_are_no_seeds_of_one(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    words = ["train", "--preset", "smoke", "--env", "CartPoleEasy", "--algorithm", "ppo"]
    assert cli.main([*words, "--seed", "1", "--out", str(other)]) == 0
    words = ["analyze", "saliency", str(run), str(other), "--game", "CartPoleEasy"]
    assert cli.main([*words, "--max-steps", "6", "--out", str(tmp_path / "figure")]) == 2
    said = capsys.readouterr().err
    assert "learned CartPoleEasy-v0+SkittlesEasy-v0 (full) and CartPoleEasy-v0 (full)" in said


def test_one_game_at_a_time_is_played(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = str(run.parent / "film.gif")
    assert cli.main(["record", MIXTURE, "--player", str(run), "--out", film]) == 2
    assert "one game, not several" in capsys.readouterr().err
    assert cli.main(["record", "SkittlesEasy", "--player", str(run), "--out", film]) == 0
    assert "note: this agent was trained on" not in capsys.readouterr().out


def test_returns_of_a_mixture_have_no_common_scale() -> None:
    with pytest.raises(ValueError, match="no scale in common"):
        normalise("BattleShipEasy-v0+CartPoleEasy-v0", 0.5)


def test_a_mixture_has_one_name_with_versions_and_without() -> None:
    pinned = "CartPoleEasy-v0+2*SkittlesEasy-v0"
    bare = "CartPoleEasy+2*SkittlesEasy"
    assert bare_name(pinned) == bare_name(bare) == bare
    names = game_names([pinned, bare, "CartPoleEasy-v0"])
    assert names[pinned] == names[bare] != names["CartPoleEasy-v0"]


def test_a_mixture_that_stopped_exploring_is_told(tmp_path: Path) -> None:
    rows = ["frames,train_return,entropy", *(f"{n},-0.5,0.001" for n in range(1, 101))]
    (tmp_path / "metrics.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "config.json").write_text('{"config": {"env": "BattleShipEasy+NavigatorEasy"}}')
    assert "0.996 can be had" in stopped_exploring(Run(tmp_path))
