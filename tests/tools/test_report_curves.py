"""Learning curves of a report: their scale, the lines of the players, and what stands below."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures.logs import Curve
from arcade_torch.tools.figures.style import drawing
from arcade_torch.tools.measures.bootstrap import pooled
from arcade_torch.tools.reports import panels
from tests.tools.fabricated import small_study, write_study

GAME = "MineSweeperEasy"


@pytest.fixture
def axes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes the axes of both twins of a study whose seeds lie far apart, by the players' means."""
    monkeypatch.setattr(panels.style, "svg", lambda figure, name: figure)
    folder = write_study(tmp_path, small_study(), spread=2.0)
    runs = find_runs([folder.root])

    def make(means: Mapping[str, float]) -> list[Any]:
        with drawing("light"):
            made = panels.curve_panels(runs, "eval", {GAME: means}, ["mingru", "mlp"], False)
        figures: list[Any] = [panel["picture"] for panel in made]
        return [figure.axes[0] for figure in figures]

    return make


def test_the_twins_of_a_game_share_a_scale_that_holds_every_seed_and_every_player(
    axes: Any,
) -> None:
    full, partial = axes({})
    low, high = full.get_ylim()
    assert (low, high) == partial.get_ylim()
    assert low < -0.6 and high > 1.4  # means of one seed less, and of one more
    low, high = axes({"random": -3.0, "state": 3.0})[0].get_ylim()
    assert low < -3 and high > 3


@pytest.mark.filterwarnings("error")  # of matplotlib, which makes a height of its own
def test_a_scale_of_equal_returns_has_a_height(tmp_path: Path) -> None:
    folder = write_study(tmp_path, small_study(memories=["mlp"], seeds=[0]))
    for file in folder.root.glob("runs/*/eval.csv"):
        file.write_text("frames,mean,std,n\n10,0.5,0,8\n20,0.5,0,8\n")
    runs = find_runs([folder.root])
    with drawing("light"):
        made = panels.curve_panels(runs, "eval", {}, ["mlp"], False)
    assert [panel["caption"] for panel in made] == ["mean of 1 seed"] * 2


def test_lines_of_players_that_lie_close_share_one_name() -> None:
    means = {"random": 0.0, "state": 1.0, "frames": 0.95}
    assert panels._named_levels(means, "partial", 0.1) == {
        "random": 0.0,
        "oracle, frames oracle": 1.0,
    }
    assert panels._named_levels(means, "partial", 0.01) == {
        "random": 0.0,
        "oracle": 1.0,
        "frames oracle": 0.95,
    }
    assert panels._named_levels(means, "full", 0.01) == {"random": 0.0, "oracle": 1.0}


def test_a_caption_counts_the_seeds_behind_the_curves() -> None:
    one = Curve(np.array([10.0]), pooled([[0.5]]))
    three = Curve(np.array([10.0]), pooled([[0.5], [0.6], [0.7]]))
    assert panels._curve_caption([one, one]) == "mean of 1 seed"
    assert panels._curve_caption([three, one]) == "mean of 1 or 3 seeds; band: interval over seeds"
