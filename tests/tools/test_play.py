"""Play: the session as a state machine, its scores, a window (on SDL's dummy driver) and a terminal
(on a pty).
"""

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import arcade_torch
from arcade_torch.agents.runs.files import read_csv
from arcade_torch.compiled import compiled_game
from arcade_torch.envs_jax import ACTION_NAMES
from arcade_torch.tools import cli
from arcade_torch.tools.files import write_csv
from arcade_torch.tools.play import screens
from arcade_torch.tools.play.scores import COLUMNS, append_score, replay, score_row
from arcade_torch.tools.play.session import KEYS, Attempt, Session
from arcade_torch.tools.scores import read_scores

ROOT = Path(__file__).resolve().parents[2]
GAME = "MineSweeperEasy"


def session(**options: object) -> tuple[Session, list[Attempt]]:
    """A session of the shortest game, and the list that its attempts go to."""
    found: list[Attempt] = []
    return Session(
        compiled_game(GAME, 128, "default", {}), on_attempt=found.append, **options
    ), found


def press(player: Session, keys: str) -> None:
    """Press keys given as one digit an action, or r, p, n (next), q."""
    names = {"r": "restart", "p": "toggle", "n": "next", "q": "quit"}
    for key in keys:
        player.press(names[key] if key in names else ACTION_NAMES[int(key)])


def to_the_end(player: Session) -> None:
    """Run into the time limit."""
    while player.end is None:
        player.press("up")


def test_a_session_walks_the_path_of_arcade_env() -> None:
    player, _ = session(seed=7, partial=True)
    env = arcade_torch.make(GAME, num_envs=1, observability="partial", seed=7)
    root = env.reset()
    assert (player.frame == root["pixels"][0].numpy()).all()
    for action in "413430":
        step = env.step(root.set("action", env.action_spec.zero() + int(action)))["next"]
        press(player, action)
        assert (player.frame == step["pixels"][0].numpy()).all()
        assert (player.total, player.steps) == (
            step["episode_reward"].item(),
            step["step_count"].item(),
        )
        if step["done"].item():
            break
        root = step.select("pixels")
    assert (player.end is not None) == step["done"].item()


def test_the_last_picture_stays_until_the_player_goes_on() -> None:
    player, found = session(seed=3)
    to_the_end(player)
    assert player.steps == player.game.max_steps and player.end == "truncated"
    last, caption = player.frame, player.caption
    press(player, "01234")
    assert (
        (player.frame == last).all()
        and player.caption == caption
        and player.steps == player.game.max_steps
    )
    assert "Enter for the next" in caption
    press(player, "n")
    assert (player.seed, player.steps, player.end, player.closed) == (4, 0, None, False)
    assert [(a.seed, a.attempt, a.end, a.steps) for a in found] == [
        (3, 1, "truncated", player.game.max_steps)
    ]


def test_a_session_closes_after_its_episodes() -> None:
    player, found = session(episodes=2)
    for _ in range(2):
        assert not player.closed
        to_the_end(player)
        says = player.caption
        press(player, "n")
    assert player.closed and "Enter ends" in says
    assert [a.seed for a in found] == [0, 1]
    press(player, "0rn")  # a closed session hears nothing
    assert player.closed and len(found) == 2


def test_restart_begins_the_same_episode_and_counts_the_attempt() -> None:
    player, found = session(seed=5)
    first = player.frame
    press(player, "31r")
    assert (player.frame == first).all() and (player.seed, player.steps, player.total) == (
        5,
        0,
        0.0,
    )
    press(player, "r")  # nothing was played: nothing to report
    to_the_end(player)
    press(player, "r")  # an episode that has ended counts
    assert player.end == "truncated" and not player.closed
    assert [(a.attempt, a.end, a.actions[:2]) for a in found] == [
        (1, "abandoned", "31"),
        (3, "truncated", "00"),
    ]


def test_quitting_reports_what_was_played() -> None:
    player, found = session()
    press(player, "20q")
    assert player.closed and [(a.end, a.actions) for a in found] == [("abandoned", "20")]
    untouched, nothing = session()
    press(untouched, "q")
    assert untouched.closed and not nothing


def test_the_twin_changes_in_mid_episode_and_the_game_does_not() -> None:
    full, partial, changing = (session(seed=3, partial=start)[0] for start in (False, True, False))
    for keys in ("4", "3"):
        for player in (full, partial, changing):
            press(player, keys)
    assert not (full.frame == partial.frame).all()
    assert (changing.frame == full.frame).all() and " MDP " in changing.caption
    press(changing, "p")
    assert (changing.frame == partial.frame).all() and " POMDP " in changing.caption
    assert changing.total == full.total


@pytest.mark.parametrize(
    ("options", "keys", "observability"),
    [
        ({}, "0", "full"),
        ({"partial": True}, "0", "partial"),
        ({}, "0p", "mixed"),
        ({}, "pp0", "mixed"),  # the first picture was seen in both
        ({"both": True}, "0", "both"),
        ({"both": True}, "0p", "both"),
    ],
)
def test_a_score_says_what_the_player_saw(
    options: dict[str, bool], keys: str, observability: str
) -> None:
    player, found = session(**options)
    press(player, keys + "q")
    assert found[0].observability == observability


def test_changing_the_twin_after_an_end_changes_no_score() -> None:
    player, found = session()
    to_the_end(player)
    press(player, "pn0q")
    assert [a.observability for a in found] == ["full", "partial"]


def test_both_twins_stand_side_by_side() -> None:
    both, full, partial = session(both=True)[0], session()[0], session(partial=True)[0]
    for player in (both, full, partial):
        press(player, "43")
    assert both.frame.shape == (128, 256, 3)
    assert (both.frame == np.concatenate([full.frame, partial.frame], axis=1)).all()


def test_the_caption_has_return_steps_and_last_reward() -> None:
    player, _ = session(seed=3)
    press(player, "43")
    pattern = r"MineSweeperEasy-v0 MDP  return ([+-]\d\.\d{3})  steps 2/32  last [+-]\d\.\d{3}"
    match = re.fullmatch(pattern, player.caption)
    assert match and float(match[1]) == pytest.approx(player.total, abs=5e-4)


def test_bad_sessions_and_keys_are_refused() -> None:
    with pytest.raises(ValueError, match="episodes must be 0"):
        session(episodes=-1)
    with pytest.raises(ValueError, match="seed is -1, allowed: 0 to 4294967295"):
        session(seed=-1)
    with pytest.raises(ValueError, match="key must be one of up, down"):
        session()[0].press("jump")


# -- scores ----------------------------------------------------------------------------------------


def write_scores(path: Path) -> list[Attempt]:
    player, found = session(seed=1, partial=True)
    press(player, "43r4")
    to_the_end(player)
    press(player, "n")
    to_the_end(player)
    for attempt in found:
        append_score(path, score_row(attempt, player.game, {}, "ann"))
    return found


def test_every_score_can_be_replayed_from_its_line(tmp_path: Path) -> None:
    found = write_scores(tmp_path / "human.csv")
    rows = read_csv(tmp_path / "human.csv")
    assert tuple(rows[0]) == COLUMNS and len(rows) == 3
    for row, attempt in zip(rows, found, strict=True):
        again = replay(row)
        assert (again.actions, again.total, again.end) == (
            attempt.actions,
            attempt.total,
            attempt.end,
        )
    assert [row["return"] == "" for row in rows] == [
        True,
        False,
        False,
    ]  # an abandoned episode has no score
    assert {(row["model"], row["env"], row["difficulty"]) for row in rows} == {
        ("human", "MineSweeper", "easy")
    }
    with pytest.raises(ValueError, match="the episode ends after 32"):
        replay({**rows[2], "actions": rows[2]["actions"] + "0"})


def test_the_analyses_read_the_scores(tmp_path: Path) -> None:
    found = write_scores(tmp_path / "human.csv")
    scores = read_scores(tmp_path / "human.csv")
    assert [(s.agent, s.game, s.observability, s.seed) for s in scores] == [
        ("human", "MineSweeperEasy-v0", "partial", 1),
        ("human", "MineSweeperEasy-v0", "partial", 2),
    ]
    assert [s.value for s in scores] == pytest.approx(
        [a.total for a in found if a.end != "abandoned"]
    )


# -- window ----------------------------------------------------------------------------------------


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> object:
    """pygame without a screen."""
    module = pytest.importorskip("pygame", reason="needs the play extra: pip install '.[play]'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    module.display.init()
    yield module
    module.display.quit()


def test_a_window_plays_what_is_pressed_and_shows_it(
    pygame: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    player, found = session(seed=3)
    shown = []
    original = screens.Window.show

    def show(self: screens.Window, frame: np.ndarray, title: str) -> None:
        original(self, frame, title)
        surface = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
        shown.append((surface, pygame.display.get_caption()[0]))

    keys = ["K_SPACE", "K_RIGHT", "K_q", "K_p", "K_r", "K_UP", "K_DOWN", "K_LEFT"]
    events = [[pygame.event.Event(pygame.KEYDOWN, key=getattr(pygame, key))] for key in keys]
    events.append([pygame.event.Event(pygame.QUIT)])
    monkeypatch.setattr(screens.Window, "show", show)
    monkeypatch.setattr(pygame.event, "get", lambda types: events.pop(0))
    screens.play_in_window(player, scale=3, key_repeat_ms=50)
    assert player.closed and pygame.display.get_surface() is None
    assert [a.actions for a in found] == ["43", "012"]
    twin, _ = session(seed=3)
    frames = [twin.picture]
    for keys in ("4", "3", "p"):
        press(twin, keys)
        frames.append(twin.picture)
    assert len(shown) == 9  # the first picture, and one for each key that means something
    for (surface, _), frame in zip(shown, frames, strict=False):
        assert surface.shape == (420, 384, 3) and (surface[1::3, 1::3] == frame).all()
    assert "steps 1/32" in shown[1][1] and " POMDP " in shown[3][1]


def test_every_key_of_the_window_and_of_the_terminal_is_one_of_the_session(pygame: object) -> None:
    assert set(screens.WINDOW_KEYS.values()) == set(KEYS) == set(screens.TERMINAL_KEYS.values())
    assert all(hasattr(pygame, constant) for constant in screens.WINDOW_KEYS)


def test_without_display_or_pygame_there_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert "pip install '.[play]'" in str(screens.why_no_window())


def test_without_a_display_there_is_a_reason(
    pygame: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert screens.why_no_window() is None
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert screens.why_no_window() == "there is no display"


# -- terminal --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"\x1b[A\x1b[B\x1b[D\x1b[C ", ["up", "down", "left", "right", "fire"]),
        (b"\x1bOA\x1bOC", ["up", "right"]),
        (b"rRpP\r\n", ["restart", "restart", "toggle", "toggle", "next", "next"]),
        (b"\x1b", ["quit"]),
        (b"q\x03\x04", ["quit", "quit", "quit"]),
        (b"xyz\x1b[5~\x1b[1;5A\x1b[A", ["up"]),  # other letters, page up, control and up: nothing
        (b"\x1b[", []),
    ],
)
def test_terminal_sequences_are_keys(data: bytes, keys: list[str]) -> None:
    assert screens.decode_keys(data) == keys


def painted(lines: list[str]) -> np.ndarray:
    """The pixels that half blocks draw."""
    rows = []
    for line in lines:
        upper, lower, colour = [], [], [0] * 6
        for code, block in re.findall(r"\x1b\[([\d;]+)m|(\u2580)", line):
            if block:
                upper.append(colour[:3])
                lower.append(colour[3:])
            elif code != "0":
                numbers = [int(n) for n in code.split(";")]
                assert (numbers[:2], numbers[5:7]) == ([38, 2], [48, 2])
                colour = numbers[2:5] + numbers[7:]
        rows += [upper, lower]
    return np.array(rows, np.uint8)


def test_half_blocks_draw_every_pixel() -> None:
    player, _ = session()
    assert (painted(screens.half_blocks(player.frame, 128, 128)) == player.frame).all()


@pytest.mark.parametrize(("height", "width"), [(128, 128), (44, 80), (300, 300), (2, 7), (1, 1)])
def test_a_frame_shrinks_to_the_terminal_and_keeps_its_mean(height: int, width: int) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (128, 128, 3)).astype(np.uint8)
    side = min(height, width, 128)
    small = painted(screens.half_blocks(frame, height, width))[
        :side
    ]  # an odd last row has a black one below it
    assert small.shape == (side, side, 3)
    assert small.mean() == pytest.approx(frame.mean(), abs=1.5)
    flat = np.full_like(frame, 77)
    assert (painted(screens.half_blocks(flat, height, width))[:side] == 77).all()


def test_the_screen_fits_the_terminal() -> None:
    player, _ = session(both=True)
    lines = screens.screen(player, 80, 24).split("\r\n")
    plain = [re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", line) for line in lines]
    assert len(plain) <= 24 and max(map(len, plain)) <= 80
    assert player.caption[:80] in plain


def talk(
    words: list[str], keys: list[Any], size: tuple[int, int] = (24, 80)
) -> tuple[int, str, bytes]:
    """Run the command on a pseudo terminal; each key is sent, or function called, when the picture
    has been drawn anew.
    """
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", *size, 0, 0))
    before = termios.tcgetattr(slave)
    env = {
        k: v
        for k, v in os.environ.items()
        if k not in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    }
    command = [sys.executable, "-m", "arcade_torch.tools", *words]
    process = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, cwd=ROOT, env=env)
    out, limit = b"", time.monotonic() + 120
    pictures = 0
    while process.poll() is None and time.monotonic() < limit:
        if select.select([master], [], [], 0.2)[0]:
            out += os.read(master, 65536)
        drawn = out.count(b"\x1b[J")
        if drawn > pictures and keys:
            pictures = drawn
            key = keys.pop(0)
            if callable(key):
                key(process, slave)
            else:
                os.write(master, key)
    process.kill()
    process.wait()
    while select.select([master], [], [], 0)[0]:
        out += os.read(master, 65536)
    assert termios.tcgetattr(slave) == before  # echo and line mode are back
    os.close(master)
    os.close(slave)
    return process.returncode, out.decode(), b"".join(keys)


def test_a_terminal_plays_and_is_left_as_it_was(tmp_path: Path) -> None:
    """Without a display, so that the terminal is chosen by itself; keys arrive one picture after
    the other.
    """
    scores = tmp_path / "human.csv"
    words = [
        "play",
        GAME,
        "--obs-size",
        "128",
        "--seed",
        "3",
        "--partial",
        "--scores",
        str(scores),
        "--player",
        "ann",
    ]
    code, out, unread = talk(words, [b" ", b"\x1b[C", b"p", b"\x1b"])
    assert (code, unread) == (0, b""), out
    assert "playing in the terminal: " in out
    assert (
        out.count("\x1b[?1049h") == out.count("\x1b[?1049l") == 1
        and out.count("\x1b[?25l\x1b[2J") == 1
    )
    assert "steps 2/32" in out and " MDP " in out and " POMDP " in out
    said = out.split("\x1b[?1049l")[1]
    assert re.search(r"seed 3 \(mixed\): return [+-]\d\.\d+ in 2 steps, abandoned", said)
    (row,) = read_csv(scores)
    assert (row["actions"], row["seed"], row["player"], row["end"]) == (
        "43",
        "3",
        "ann",
        "abandoned",
    )


@pytest.mark.slow
def test_ctrl_z_leaves_the_terminal_as_it_was_until_the_game_goes_on() -> None:
    def stop(process: subprocess.Popen[bytes], slave: int) -> None:
        playing = termios.tcgetattr(slave)
        process.send_signal(signal.SIGTSTP)
        os.waitpid(process.pid, os.WUNTRACED)
        assert termios.tcgetattr(slave)[3] & termios.ICANON and not playing[3] & termios.ICANON
        process.send_signal(signal.SIGCONT)

    words = ["play", GAME, "--obs-size", "128", "--terminal"]
    code, out, unread = talk(words, [b" ", stop, b"\x1b"])
    assert (code, unread) == (0, b""), out
    assert out.count("\x1b[?1049h") == out.count("\x1b[?1049l") == 2
    assert out.split("\x1b[?1049h")[2].startswith("\x1b[?25l\x1b[2J\x1b[H")  # it is drawn anew


def test_a_terminal_without_the_blocks_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    for encoding, reason in (("utf-8", None), ("ascii", "text is written in ascii, without the")):
        terminal = SimpleNamespace(isatty=lambda: True, encoding=encoding)
        monkeypatch.setattr(sys, "stdin", terminal)
        monkeypatch.setattr(sys, "stdout", terminal)
        said = screens.why_no_terminal()
        assert said is reason or reason in said


def test_a_terminal_of_twenty_columns_shows_a_picture() -> None:
    code, out, unread = talk(
        ["play", GAME, "--obs-size", "128", "--terminal"], [b" ", b"\x1b"], size=(3, 20)
    )
    assert (code, unread) == (0, b""), out


# -- command ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["play"], "Missing from arcade-torch play"),
        (["play", "MineSweperEasy"], "did you mean 'MineSweeperEasy'"),
        (["play", GAME, "--scale", "0"], "--scale must be at least 1, got 0"),
        (["play", GAME, "--key-repeat", "-1"], "--key-repeat must be at least 0"),
        (["play", GAME, "--episodes", "-1"], "episodes must be 0 (no end) or more; got -1"),
        (["play", GAME, "--obs-size", "64"], "64"),
        (["play", GAME, "--seed", "-1"], "seed is -1, allowed: 0 to 4294967295"),
        (
            ["play", GAME, "--scores", "x.txt"],
            "--scores must be a file that ends in .csv; got 'x.txt'",
        ),
        (["play", GAME, "--env-option", "wind"], "NAME=VALUE"),
        (["play", GAME, "--env-option", "wind=1"], "has no option 'wind'"),
        (["play", GAME, "--terminal"], "playing needs a window or a terminal"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and message in err
    assert not list(tmp_path.iterdir())


def test_a_table_of_something_else_is_left_alone(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    write_csv(tmp_path / "results.csv", [{"a": 1}], ["a"])
    assert cli.main(["play", GAME, "--scores", str(tmp_path / "results.csv")]) == cli.EXIT_BAD_INPUT
    assert "is no table of human scores" in capsys.readouterr().err
    assert (tmp_path / "results.csv").read_text() == "a\n1\n"


def test_the_command_opens_a_window_and_goes_on_with_seeds_that_the_player_has_not_met(
    pygame: object,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    met = []

    def play(player: Session, scale: int, key_repeat_ms: int, watched: object) -> None:
        assert watched is None
        met.append((player.seed, scale, key_repeat_ms, player.game.obs_size))
        press(player, "0q")

    monkeypatch.setattr(screens, "play_in_window", play)
    words = ["play", GAME, "--scale", "3", "--key-repeat", "80", "--obs-size", "128"]
    words += ["--scores", str(tmp_path / "h.csv"), "--player"]
    for player in ("ann", "ann", "bob"):
        assert cli.main([*words, player]) == 0
    assert met == [(0, 3, 80, 128), (1, 3, 80, 128), (0, 3, 80, 128)]
    assert "seed 1 (full): return " in capsys.readouterr().out


def test_an_episode_that_a_signal_cuts_off_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: it was lost, and the next session gave the same seed as one never met."""

    def play(played: Session, scale: int, key_repeat: int, watched: None) -> None:
        played.press("right")
        played.press("down")
        raise KeyboardInterrupt  # as SIGTERM and Ctrl-C do

    monkeypatch.setattr(screens, "why_no_window", lambda: None)
    monkeypatch.setattr(screens, "play_in_window", play)
    words = ["play", GAME, "--scores", str(tmp_path / "human.csv")]
    for seed in (0, 1):
        assert cli.main(words) == 130
        row = read_csv(tmp_path / "human.csv")[seed]
        assert (row["seed"], row["end"], row["steps"]) == (str(seed), "abandoned", "2")
        assert f"seed {seed} (full): return" in capsys.readouterr().out
