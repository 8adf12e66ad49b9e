"""Strips of one episode: moments side by side, the MDP above the POMDP."""

from pathlib import Path

import numpy as np
import pytest

from arcade_torch.tools import cli
from arcade_torch.tools.play.captions import HEIGHT, PAPER, caption
from arcade_torch.tools.play.recording import GAP, scene, strip


def test_a_strip_is_made_of_scenes_with_a_gap_between_them() -> None:
    drawn = strip("SignpostEasy", [0, 1], obs_size=128)
    top = drawn[:HEIGHT]
    middle = drawn[HEIGHT + 128 + GAP : -128]
    assert drawn.shape == (2 * (HEIGHT + 128) + GAP, 2 * 128 + GAP, 3)
    assert np.array_equal(top, caption(["MDP"], 2 * 128 + GAP, 1))
    assert np.array_equal(middle, caption(["POMDP"], 2 * 128 + GAP, 1))
    rows = np.concatenate([drawn[HEIGHT : HEIGHT + 128], drawn[-128:]])
    assert (drawn[HEIGHT + 128 : HEIGHT + 128 + GAP] == PAPER).all()
    assert (rows[:, 128:-128] == PAPER).all()
    for column, steps in enumerate((0, 1)):
        full, partial = scene("SignpostEasy", 128, steps)
        x = column * (128 + GAP)
        assert np.array_equal(rows[:128, x : x + 128], full)
        assert np.array_equal(rows[128:, x : x + 128], partial)


@pytest.mark.parametrize("steps", [[], [-1], [2, 2], [3, 1]])
def test_moments_have_to_follow_each_other(steps: list[int]) -> None:
    with pytest.raises(ValueError, match="rise"):
        strip("SignpostEasy", steps)


def test_a_moment_behind_the_end_is_refused_with_the_length_of_the_episode() -> None:
    strip("SignpostEasy", [4], obs_size=128)
    with pytest.raises(ValueError, match="ends after 5 steps"):
        strip("SignpostEasy", [5], obs_size=128)


def test_a_strip_is_of_one_game(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "list",
        "sheet",
        "SignpostEasy",
        "SignpostHard",
        "--steps",
        "0",
        "--out",
        str(tmp_path / "s.png"),
    ]
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    assert "one game" in capsys.readouterr().err
    assert cli.main([*words[:3], *words[4:]]) == cli.EXIT_OK
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")
