"""``arcade-torch new memory``: a file that keeps the laws and learns, and overwrites nothing."""

import resource
import runpy
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from arcade_torch.models import check_memory, make_memory
from arcade_torch.tools import cli
from arcade_torch.tools.commands.new import TEMPLATE
from tests.tools.test_cli import one_error


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["new", "memory", "my_own"]) == cli.EXIT_OK
    return tmp_path / "my_own.py"


@pytest.fixture
def memory(path: Path) -> Any:
    """The class in the file, which was registered by its name."""
    return runpy.run_path(str(path))["MyOwnMemory"]


def test_the_file_keeps_the_laws_as_it_stands(memory: Any) -> None:
    check_memory(memory(5, 3))
    assert isinstance(make_memory("my_own", 4, 8, slowest_gate=3.0), memory)


def test_it_learns_to_recall_a_symbol(memory: Any) -> None:
    """One of two symbols at the first step, noise for nine more: which one was it?"""
    torch.manual_seed(0)
    cell = memory(3, 16)
    head = nn.Linear(16, 2)
    optimiser = torch.optim.Adam([*cell.parameters(), *head.parameters()], lr=1e-2)
    is_init = torch.zeros(64, 10, dtype=torch.bool)
    for _ in range(200):
        symbol = torch.randint(2, (64,))
        x = torch.randn(64, 10, 3)
        x[:, :, :2] = 0
        x[torch.arange(64), 0, symbol] = 1
        y, _ = cell(x, cell.initial_state(64), is_init)
        logits = head(y[:, -1])
        loss = nn.functional.cross_entropy(logits, symbol)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert float((logits.argmax(-1) == symbol).float().mean()) == 1.0


def test_run_as_a_script_it_names_the_laws(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    runpy.run_path(str(path), run_name="__main__")
    assert "packed equals apart: " in capsys.readouterr().out


def test_it_is_a_page_that_says_what_to_change() -> None:
    text = TEMPLATE.read_text()
    assert len(text.splitlines()) <= 64 and max(map(len, text.splitlines())) <= 100
    assert text.count("CHANGE") >= 5


def test_nothing_is_overwritten(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path.write_text("mine")
    capsys.readouterr()
    assert "my_own.py exists: choose another name" in one_error(capsys, ["new", "memory", "my_own"])
    assert path.read_text() == "mine"


def test_a_file_that_could_not_be_written_whole_can_be_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An empty file was left, and "my_own.py exists" was the answer from then on."""
    monkeypatch.chdir(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        said = one_error(capsys, ["new", "memory", "my_own"], cli.EXIT_FAILED)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "could not write my_own.py" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Mine", "lower case letters"),
        ("../x", "lower case letters"),
        ("class", "no word of Python's grammar"),
        ("lru", "there is a memory model 'lru' already"),
        ("fart", "there is a memory model 'fart' already"),
        ("random", "would hide the module random of Python"),
        ("torch", "would hide the module torch of Python"),
    ],
)
def test_a_name_that_cannot_be_is_one_line(
    name: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in one_error(capsys, ["new", "memory", name])
    assert not list(tmp_path.iterdir())
