"""The line that says how a run stands."""

import time
from io import StringIO

import pytest
from rich.text import Text

from arcade_torch.tools.progress import Bars, describe_row

ROW = {
    "frames": 4_000,
    "total_frames": 16_000,
    "train_return_ewm": 0.25,
    "train_return_last": 0.5,
    "eval_return": None,
    "loss": 0.0123,
    "epsilon": 0.4,
    "entropy": None,
    "lr": 5e-5,
}


def test_a_line_shows_speed_and_time_left_and_the_last_line_how_far_it_came(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, stream = [100.0], StringIO()
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr("rich.console.monotonic", lambda: now[0])
    with Bars(stream, "frames") as bars:
        for done in (9_000, 10_000, 11_000, 12_000):  # what there was at the start is no speed
            bars.update("run", done, 16_000, "return 0.250")
            now[0] += 10
    assert stream.getvalue().splitlines() == [
        "run: 11,000 of 16,000 frames (69 %), 100 frames/s, 0:00:50 left, return 0.250",
        "run: 12,000 of 16,000 frames (75 %), 100 frames/s, 0:00:40 left, return 0.250",
    ]


def test_what_is_no_work_of_frames_prints_a_line_now_and_then_only() -> None:
    stream = StringIO()
    with Bars(stream) as bars:
        bars.update("players", 1, 3)
    with Bars(stream, first_line_s=0) as bars:
        bars.update("players", 2, 3)
        bars.update("film", 7, 0, "frame 7")
    assert stream.getvalue() == "players: 2 of 3 (67 %)\n"
    with Bars(stream, first_line_s=0) as bars:
        bars.update("card gru", 0, 0, "laws")
    assert stream.getvalue().splitlines()[1:] == ["card gru: laws"]


def test_a_policy_that_is_sampled_shows_its_entropy_and_the_greedy_return_appears_when_there_is_one() -> (
    None
):
    row = {**ROW, "epsilon": None, "entropy": 1.5, "eval_return": -0.125}
    assert (
        describe_row(ROW)
        == "return 0.250, of last episodes 0.500, loss 0.0123, epsilon 0.40, lr 5.0e-05"
    )
    assert "greedy -0.125, loss 0.0123, entropy 1.50, lr" in describe_row(row)
    assert describe_row({"frames": 1, "total_frames": 2, "lr": 1e-3}) == "lr 1.0e-03"


class Screen(StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [60, 80, 200])
@pytest.mark.parametrize("name", ["runs/one", "runs/SignpostEasy__partial__gru__pqn__seed0"])
def test_a_terminal_shows_how_far_a_run_is_and_all_that_is_said_of_it(
    name: str, columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "xterm")
    with Bars(stream := Screen(), "frames") as bars:
        bars.update(name, 4_000, 16_000, describe_row(ROW))
        bars._bars.refresh()
    shown = Text.from_ansi(stream.getvalue()).plain
    assert " 25%" in shown and "━" in shown and "…" not in shown.replace(name[:4], "")
    assert all(word in shown for word in describe_row(ROW).split())
