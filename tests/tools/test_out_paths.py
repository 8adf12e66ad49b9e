"""What a command writes is checked before the work for it begins; pipes and devices are never
replaced by files.
"""

import errno
import os
import stat
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.agents.runs.files import check_writable, write_atomic
from arcade_torch.tools import cli
from arcade_torch.tools.errors import one_line
from tests.tools.fabricated import small_study, write_study
from tests.tools.test_cli import one_error

AGENT = "signpost-partial-lru"
COMMANDS = {
    "record": ("record SignpostEasy --out {}.gif", ".gif"),
    "evaluate": (f"evaluate {AGENT} --json {{}}", ""),
    "report": ("report study --out {}", ""),
    "figure": ("figure curves study --out {}.png", ".png"),
    "analyze": (f"analyze saliency {AGENT} --out {{}}.csv", ".csv"),
    "card": ("card lru --no-tests --out {}/cards", ""),
    "sheet": ("list sheet SignpostEasy --out {}", ""),
    "baselines": ("list baselines SignpostEasy --out {}", ""),
    "submit": ("leaderboard submit study --name x --out {}", ""),
    "check": ("leaderboard check {}/x.json --runs study --record", ""),
    "push": (f"push {AGENT} ./{{}}/agent", ""),
    "pull": (f"pull {AGENT} --out {{}}/agent", ""),
    "new memory": ("new memory yours --out {}/yours.py", ""),
}
WORK = (
    "arcade_torch.compiled.compiled_game",
    "arcade_torch.agents.evaluation.evaluate",
    "arcade_torch.tools.reports.report",
    "arcade_torch.tools.figures.catalogue.import_module",
    "arcade_torch.tools.cards.measure.measure_card",
    "arcade_torch.tools.play.recording.sheet",
    "arcade_torch.tools.players.measure",
    "arcade_torch.tools.board.submit.submit",
    "arcade_torch.tools.board.check.check",
    "arcade_torch.tools.sharing.share.share",
)


@pytest.fixture
def no_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The current folder has a study, and no command may begin with its work."""
    monkeypatch.chdir(tmp_path)
    write_study(tmp_path / "study", small_study())

    def work(*args: Any, **options: Any) -> Any:
        raise AssertionError("work has begun")

    for name in WORK:
        monkeypatch.setattr(name, work)


def refusal(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a command refuses its options."""
    assert cli.main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_where_a_folder_should_be_is_refused_before_the_work(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").write_text("kept")
    words, _ = COMMANDS[command]
    assert "file is a file, not a folder" in refusal(words.format("file/out"), capsys)
    assert Path("file").read_text() == "kept"


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize(
    "command", ["record", "evaluate", "report", "figure", "analyze", "sheet", "baselines"]
)
def test_a_pipe_is_not_replaced(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, suffix = COMMANDS[command]
    pipe = Path(f"pipe{suffix}")
    os.mkfifo(pipe)
    said = refusal(words.format("pipe"), capsys)
    assert "pipe or a device" in said or "exists" in said
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_no_file_takes_the_place_of_a_device(tmp_path: Path) -> None:
    link = tmp_path / "page.html"
    link.symlink_to(os.devnull)
    with pytest.raises(FileExistsError, match="pipe or a device"):
        write_atomic(link, "page")
    assert link.is_symlink() and os.listdir(tmp_path) == ["page.html"]


def test_what_cannot_be_written_is_known_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(IsADirectoryError, match="it is a folder: choose a file"):
        check_writable(tmp_path)
    with pytest.raises(OSError, match="File name too long"):
        check_writable(tmp_path / ("x" * 300))
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(OSError, match="symbolic links"):
        check_writable(tmp_path / "loop")
    assert check_writable(tmp_path / "not/yet/there.json") and not (tmp_path / "not").exists()
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(PermissionError, match="Permission denied"):
        check_writable(tmp_path / "not/yet/there.json")


def test_a_place_that_may_not_be_written_is_told_with_the_option_for_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_study(tmp_path / "study", small_study())
    run = tmp_path / "run"
    run.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK)
    for words in (["analyze", "saliency", str(run)], ["report", str(tmp_path / "study")]):
        said = refusal(" ".join(words), capsys)
        assert "Permission denied; choose another place (--out), or change its perm" in said
    closed = tmp_path / "closed.json"
    closed.touch()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    said = one_line(PermissionError(errno.EACCES, "Permission denied", str(closed)))
    assert said == f"could not use {closed}: Permission denied; change its permissions"


@pytest.mark.parametrize("name", ["curves.jpg", "curves.PNG"])
def test_a_picture_of_another_kind_is_no_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_study(tmp_path / "study", small_study())
    assert cli.main(["figure", "curves", "study", "--out", name]) == 2
    assert "a folder, or a file that ends in .pdf, .png, .svg, .csv" in capsys.readouterr().err
    assert not Path(name).exists()


def test_a_run_folder_is_no_agent_to_pull(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    from tests.tools.board.boards import write_run

    run = write_run(tmp_path / "runs")
    assert cli.main(["pull", str(run), "--out", "agent"]) == 2
    assert "no agent that was shared" in capsys.readouterr().err
    assert not Path("agent").exists()


def test_a_table_of_settings_may_be_a_page_and_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``--out h.md`` made a folder of that name."""
    page = tmp_path / "h.v2.md"
    assert cli.main(["figure", "hyperparameters", "--paper", "--out", str(page)]) == 0
    assert page.read_text().startswith("|")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["h.v2.csv", "h.v2.md"]
    capsys.readouterr()
    words = ["figure", "gap-bias", "--paper", "--out", str(tmp_path / "g.md")]
    assert "a folder, or a file that ends in .pdf, .png, .svg, .csv" in one_error(capsys, words)
