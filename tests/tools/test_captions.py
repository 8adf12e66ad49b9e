"""Pictures say which twin they show."""

from pathlib import Path

import numpy as np
import pytest

from arcade_torch.compiled import compiled_game
from arcade_torch.tools import cli
from arcade_torch.tools.play.captions import HEIGHT, TWINS, caption, captioned
from arcade_torch.tools.play.recording import recorded_frames, scripted
from arcade_torch.tools.play.session import TOGGLE, Session


def test_a_caption_stands_in_the_middle_of_its_share() -> None:
    both = caption(["MDP", "POMDP"], 256, 1)
    assert both.shape == (HEIGHT, 256, 3)
    for place, name in enumerate(("MDP", "POMDP")):
        share = both[:, 128 * place : 128 * (place + 1)]
        assert np.array_equal(share, caption([name], 128, 1))
        columns = np.flatnonzero((share < 255).any(axis=(0, 2)))
        assert abs(columns[0] - (127 - columns[-1])) <= 1
        assert columns[-1] - columns[0] + 1 == 6 * len(name) - 1


def test_the_picture_of_a_session_names_the_twin_that_it_shows() -> None:
    """Before: nothing in a film, and nothing but its title in a window, said which is which."""
    game = compiled_game("SignpostEasy", 128, "default", {})
    session = Session(game)
    assert np.array_equal(session.picture, captioned(session.frame, [False]))
    session.press(TOGGLE)
    assert np.array_equal(session.picture[:HEIGHT], caption([TWINS[True]], 128, 1))
    both = Session(game, both=True)
    assert np.array_equal(both.picture[:HEIGHT], caption(["MDP", "POMDP"], 256, 1))
    player = scripted("random", both.game, 0)
    film = next(recorded_frames(both, player, max_steps=1, hold=1, scale=2))
    assert film.shape == (2 * (HEIGHT + 128), 2 * 256, 3)


def test_a_sheet_shows_how_far_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before: silence for a minute and more."""
    out = tmp_path / "sheet.png"
    assert cli.main(["list", "sheet", "SignpostEasy", "--out", str(out)]) == cli.EXIT_OK
    assert "sheet: 1 of 1 (100 %), SignpostEasy-v0" in capsys.readouterr().err
