"""``--import``: a file or module of a user is there before the command runs, in workers too; errors
are one line.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from arcade_torch.envs_jax import registered_ids
from arcade_torch.tools import cli
from arcade_torch.tools.imports import VARIABLE, imported, load_extensions, take_imports
from arcade_torch.tools.options import command_line
from tests.own_registry import own_registry  # noqa: F401

OWN_GAME = Path(__file__).resolve().parents[2] / "examples/own_game.py"


def test_imports_are_taken_out_wherever_they_stand() -> None:
    words = ["--import", "one", "train", "--import=two.py", "--env", "PairsEasy"]
    assert take_imports(words) == (
        ["one", str(Path("two.py").resolve())],
        ["train", "--env", "PairsEasy"],
    )
    for incomplete in (["train", "--import"], ["train", "--import="]):
        with pytest.raises(ValueError, match=r"--import needs a file \(games.py\) or a module"):
            take_imports(incomplete)


@pytest.mark.usefixtures("own_registry")
def test_a_file_is_imported_once_and_handed_on_to_workers() -> None:
    load_extensions([str(OWN_GAME)])
    load_extensions([str(OWN_GAME)])
    assert "PairsEasy-v0" in registered_ids()
    assert os.environ[VARIABLE] == str(OWN_GAME)
    assert (
        command_line(["train", "--env", "PairsEasy"])
        == f"arcade-torch train --env PairsEasy --import {OWN_GAME}"
    )


@pytest.mark.usefixtures("own_registry")
def test_a_path_with_a_colon_reaches_workers(tmp_path: Path) -> None:
    """They took it for two paths, and no run of the study began."""
    file = tmp_path / "a:b" / "own_game.py"
    file.parent.mkdir()
    file.write_text("import math\n")
    load_extensions([str(file)])
    assert imported() == [str(file)]


@pytest.mark.usefixtures("own_registry")
def test_a_module_is_found_on_the_import_path(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "own_game_module.py").write_text(OWN_GAME.read_text())
    monkeypatch.syspath_prepend(str(tmp_path))
    load_extensions(["own_game_module"])
    assert "PairsEasy-v0" in registered_ids()


def test_a_worker_process_knows_the_game_of_the_study_that_started_it() -> None:
    code = "import sys; from arcade_torch.tools.cli import main; sys.exit(main(['list', 'envs']))"
    environment = {**os.environ, VARIABLE: str(OWN_GAME)}
    result = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert "PairsEasy-v0" in result.stdout


@pytest.mark.usefixtures("own_registry")
def test_a_file_imports_what_stands_beside_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The command said that it is not installed, where ``python FILE.py`` finds it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "model_beside.py").write_text("WIDTH = 3")
    (tmp_path / "colorsys.py").write_text("raise ValueError('hides an installed module')")
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    (tmp_path / "registers.py").write_text("import colorsys\nfrom model_beside import WIDTH\n")
    load_extensions([str(tmp_path / "registers.py")])
    assert sys.modules["model_beside"].WIDTH == 3
    monkeypatch.delitem(sys.modules, "model_beside")


@pytest.mark.usefixtures("own_registry")
@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "there is no such file"),
        ("import no_such_library", "it imports no_such_library, which is neither installed nor"),
        ("1 / 0", "it could not be imported, ZeroDivisionError: division by zero"),
        ("def", "it could not be imported, SyntaxError"),
        ("raise SystemExit(0)", "it ended the program while it was imported (SystemExit: 0)"),
        ("import sys; sys.exit('no card')", "imported (SystemExit: no card)"),
    ],
)
def test_a_file_that_cannot_be_imported_is_one_line(
    source: str | None, message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "games.py"
    if source is not None:
        path.write_text(source)
    assert cli.main(["list", "--import", str(path)]) == cli.EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and message in err and "games.py" in err


@pytest.mark.usefixtures("own_registry")
def test_a_module_that_is_not_there_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list", "--import", "no_such_games"]) == cli.EXIT_BAD_INPUT
    assert "--import no_such_games: there is no module of that name" in capsys.readouterr().err
    assert cli.main(["--import"]) == cli.EXIT_BAD_INPUT


def test_the_help_of_every_command_names_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "--help"]) == cli.EXIT_OK
    assert "--import FILE.py" in capsys.readouterr().out
    assert cli.main([]) == cli.EXIT_OK
    assert "--import FILE.py" in capsys.readouterr().out
