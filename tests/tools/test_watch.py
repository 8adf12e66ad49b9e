"""``arcade-torch play --agent``: somebody plays, another watches."""

from pathlib import Path

import pytest

from arcade_torch.compiled import compiled_game
from arcade_torch.tools import cli
from arcade_torch.tools.play import screens
from arcade_torch.tools.play.session import QUIT, Session


def session(episodes: int = 1) -> Session:
    game = compiled_game("SignpostEasy", 128, "default", {})
    return Session(game, partial=True, episodes=episodes)


def test_a_key_is_pressed_when_it_is_time_and_not_before() -> None:
    now = 0.0
    watched = screens.Watched(lambda session: 0, fps=4, clock=lambda: now)
    played = session()
    assert not watched.press(played) and watched.wait_s == 0.25
    now = 0.3
    assert watched.press(played) and played.steps == 1
    assert not watched.press(played) and played.steps == 1


def test_an_episode_ends_stays_for_a_second_and_the_next_one_begins() -> None:
    now = 0.0
    watched = screens.Watched(lambda session: 0, fps=10, clock=lambda: now)
    played = session(episodes=2)
    while played.end is None:
        now += watched.wait_s
        assert watched.press(played)
    assert watched.wait_s == pytest.approx(1.0)
    now += 1.0
    watched.press(played)
    assert played.end is None and played.seed == 1
    played.press(QUIT)
    assert not watched.press(played)


def test_the_command_hands_the_agent_to_the_screen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The agent that remembers the sign answers right, on its own twin and frames."""
    monkeypatch.chdir(tmp_path)
    frames = list[tuple[int, ...]]()

    def watch(played: Session, scale: int, key_repeat: int, watched: screens.Watched) -> None:
        frames.append(played.frame.shape)
        assert played.partial
        while not played.closed:
            watched._next_s = 0.0
            watched.press(played)

    monkeypatch.setattr(screens, "why_no_window", lambda: None)
    monkeypatch.setattr(screens, "play_in_window", watch)
    words = ["play", "SignpostEasy", "--agent", "signpost-partial-lru", "--episodes", "2"]
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    assert frames == [(128, 128, 3)] and out.count("return +1.000") == 2
