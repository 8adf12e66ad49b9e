"""Names and texts from files are text: to a terminal, to rich, in CSV and in Markdown."""

import csv
import io
from pathlib import Path

import pytest

from arcade_torch.tools import cli
from arcade_torch.tools.errors import one_line
from arcade_torch.tools.files import Table, csv_text, markdown_table
from arcade_torch.tools.play.scores import COLUMNS, append_score, next_seed, read_scores_file
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.text import csv_cell, markdown_cell, printable, say

OBEYED = (
    "\x1b[2J\x1b[31mred",
    "\x1b]8;;http://x\x1b\\link",
    "\x9b31m",
    "a\rb",
    "a\nb",
    "a\tb",
    "bell\x07",
    "back\x08",
    "\u202etxt.exe",
    "\u2066\u2069",
    "zero\u200bwidth",
    "line\u2028line",
    "\ud800",
    "\udcff",
    "\ufeff",
    "\U000e0041",
)
MARKUP = ("[red]x[/red]", "[link=http://x]y[/link]", "[/]", ":warning:", "[bold", "\\[x]")


def assert_harmless(text: str) -> None:
    """No character but line breaks that a terminal does not show."""
    assert all(char == "\n" or char.isprintable() for char in text), ascii(text)


@pytest.mark.parametrize("text", OBEYED)
def test_what_a_terminal_would_obey_is_written_out(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_harmless(printable(text))
    assert printable(text) != text and printable(printable(text)) == printable(text)
    say(text)
    with Bars(stream := io.StringIO(), first_line_s=0.0) as bars:
        bars.update(text, 1, 2, text)
        bars.note(text)
    Table(text, (text, "b"), [(text, text)], text).show()
    out = capsys.readouterr().out
    assert_harmless(out + stream.getvalue() + one_line(ValueError(text)) + csv_text([{text: text}]))


@pytest.mark.parametrize("text", ["γραφή", "日本語", "naïve é", "a b", "🦖", "x" * 500])
def test_words_of_all_languages_stay(text: str) -> None:
    assert printable(text) == text == csv_cell(text)


@pytest.mark.parametrize("text", MARKUP)
def test_markup_is_shown_and_not_carried_out(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with Bars(stream := io.StringIO(), first_line_s=0.0) as bars:
        bars.update(text, 1, 2, text)
        bars.note(text)
    Table(text, ("name", text), [(text, 1)], text).show()
    assert capsys.readouterr().out.count(text) >= 3
    assert stream.getvalue().count(text) == 3


@pytest.mark.parametrize("columns", [40, 60, 80, 200])
def test_a_table_is_no_wider_than_the_terminal(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    says = "a memory whose rows forget at rates of their own, with a delta rule, in every channel"
    Table("", ("name", "what it is"), [("rwkv7", says)], left=2).show()
    Table("", ("name", *[f"number {i}" for i in range(9)]), [("rwkv7", *range(9))]).show()
    numbers = [f"n{i}" for i in range(9)]
    Table("", ("name", *numbers), [("x" * 40, *range(9))]).show()
    out = capsys.readouterr().out
    assert out.count("┏") == {40: 9, 60: 6, 80: 5, 200: 3}[columns]
    assert columns < 200 or "x" * 40 in out
    assert max(map(len, out.splitlines())) <= columns
    assert all(word in out for word in (*says.split(), *[f"number {i}" for i in range(9)]))


@pytest.mark.parametrize(
    "text", ["=1+1", "+x", "-x", "@SUM(A1)", '=HYPERLINK("x")', "\t=1", "\r=1", "--", "+"]
)
def test_no_cell_of_a_table_is_a_formula(text: str) -> None:
    rows = list(
        csv.reader(io.StringIO(csv_text([{"agent": text, text: 1}, {"agent": Path(text)}])))
    )
    assert len(rows) == 3
    for cell in (rows[0][1], rows[1][0], rows[2][0]):
        assert cell[0] not in "=+-@\t\r\n", cell


@pytest.mark.parametrize("value", [-0.5, 0, None, True, "-0.5", "+1", "-inf", "1e-3", "-1e5"])
def test_numbers_stay_numbers(value: object) -> None:
    assert csv_cell(value) is value or csv_cell(value) == value


def test_a_player_called_like_a_formula_goes_on_with_the_next_seed(tmp_path: Path) -> None:
    file = tmp_path / "human.csv"
    row = dict.fromkeys(COLUMNS, "x") | {"game": "G", "player": "=1+1"}
    for seed in (0, 1):
        append_score(file, row | {"seed": seed})
    rows = read_scores_file(file)
    assert [one["player"] for one in rows] == ["'=1+1", "'=1+1"]
    assert next_seed(rows, "G", "=1+1") == 2


def test_no_cell_of_a_page_is_an_element() -> None:
    assert markdown_cell("<b>a|b</b>\n") == "&lt;b&gt;a\\|b&lt;/b&gt;\\n"
    assert markdown_table(["<i>"], [["<script>\n| x |"]]).count("\n") == 2


def test_errors_warnings_and_tracebacks_are_harmless(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "\x1b[31m\u202eevil"
    folder.mkdir()
    (folder / "study.json").write_text('{"study": {"name": "x"}}')
    assert cli.main(["report", str(folder)]) == cli.EXIT_BAD_INPUT
    assert cli.main(["evaluate", f"{folder}\n[red]"]) == cli.EXIT_BAD_INPUT

    def fault(self: object) -> int:
        raise KeyError("\x1b[31m")

    monkeypatch.setattr(cli.command_class("list"), "run", fault)
    assert cli.main(["list"]) == cli.EXIT_FAILED
    said = capsys.readouterr().err
    assert_harmless(said)
    assert "[red]" in said and "KeyError" in said
    shown = cli._format_warning(UserWarning("\x1b[31m\nx"), UserWarning, "a.py", 3)
    assert shown == "UserWarning: \\x1b[31m\\nx (a.py:3)\n"
