"""Refusals that need nothing heavy come before it is imported, and say what helps."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from arcade_torch.agents.runs import files
from arcade_torch.tools import cli
from arcade_torch.tools.bench import registry
from arcade_torch.tools.errors import is_told, one_line

ROOT = Path(__file__).resolve().parents[2]
MISSING = [
    ("evaluate file", "file is not a folder; give a run folder"),
    ("evaluate nosuch", "nosuch does not exist; give a run folder"),
    (
        "evaluate someone/agent",
        "someone/agent does not exist; an agent of that name on the Hugging Face hub is fetched "
        "first, arcade-torch pull someone/agent; give a run folder",
    ),
    ("push nosuch someone/agent", "nosuch does not exist; give a run folder"),
    ("analyze saliency nosuch", "nosuch does not exist"),
    ("figure returns --runs nosuch", "nosuch does not exist"),
    ("report nosuch", "nosuch is not the folder of a study: it has no study.json"),
    (
        "leaderboard page",
        "docs/leaderboard.md does not exist: run it in a checkout, or give --page",
    ),
]


def test_a_folder_that_is_not_there_is_refused_before_torch_is_imported(tmp_path: Path) -> None:
    source = (
        "import sys; from arcade_torch.tools.cli import main\n"
        f"codes = [main(line.split()) for line in {[line for line, _ in MISSING]}]\n"
        "print(codes, 'torch' in sys.modules)"
    )
    (tmp_path / "file").touch()
    ended = subprocess.run(
        [sys.executable, "-c", source],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT)},
        check=True,
    )
    assert ended.stdout.strip() == f"{[2] * len(MISSING)} False"
    for (_, message), said in zip(MISSING, ended.stderr.splitlines(), strict=True):
        assert said.startswith(f"arcade-torch: {message}")


def test_a_name_that_the_locale_cannot_write_says_what_to_set(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    error = UnicodeEncodeError("ascii", f"{tmp_path}/\xfc", 0, 1, "ordinal not in range(128)")
    assert not is_told(error)
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "ascii")
    assert is_told(error)
    wanted = f"the name {tmp_path}/\xfc cannot be written in this shell's ascii: set PYTHONUTF8=1"
    assert one_line(error).startswith(wanted)


def test_a_file_that_grows_too_large_is_no_full_disk() -> None:
    said = one_line(OSError(errno.EFBIG, "File too large", "x.pdf"))
    limit = "a file may not grow so large here: raise the limit with ulimit -f"
    assert said == f"could not write x.pdf: File too large; {limit}"


@pytest.mark.parametrize(
    ("number", "code"), [(errno.EROFS, cli.EXIT_FAILED), (errno.EACCES, cli.EXIT_BAD_INPUT)]
)
@pytest.mark.parametrize(
    "words",
    [
        "train --preset smoke --env SignpostEasy --out OUT",
        "list sheet --out OUT.png",
        "bench memory lru --out OUT.csv",
        "bench all --benches memory --out OUT.json",
    ],
)
def test_a_place_that_cannot_be_written_has_one_exit_code_with_all_commands(
    words: str,
    number: int,
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before: 2 from train on a read-only disk and 1 from the others; bench measured first."""
    monkeypatch.setattr(os, "access", lambda *args, **kwargs: False)
    monkeypatch.setattr(files, "_is_read_only", lambda place: number == errno.EROFS)
    monkeypatch.setattr(registry, "measure", None)
    assert cli.main(words.replace("OUT", str(tmp_path / "out")).split()) == code
    said = capsys.readouterr().err
    assert os.strerror(number) in said and said.count("\n") == 1
    assert not os.listdir(tmp_path)
