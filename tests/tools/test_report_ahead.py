"""Measures that several processes take for a report before it is written."""

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.tools import cli, report
from arcade_torch.tools.reports import ahead
from arcade_torch.tools.reports.ahead import Piece, measure_ahead, measure_shard
from arcade_torch.tools.studies.engines import Command, JobResult
from arcade_torch.tools.studies.folder import StudyFolder

TOML = """
games = ["MineSweeperEasy"]
memories = ["mingru"]
seeds = 1
preset = "smoke"
"""


def pieces(folder: Path, count: int, games: int = 2) -> list[Piece]:
    """Pieces of several games by turns; each writes a file of its own."""
    folder.mkdir(exist_ok=True)
    made = list[Piece]()
    for number in range(count):
        file = folder / f"piece{number}"
        made.append(Piece(f"game{number % games}", file.touch, folder, file.name))
    return made


class InThisProcess:
    """An engine that carries out the shards of pieces in this process."""

    orders: list[list[str]]
    work: list[Piece]

    def __init__(self, workers: int) -> None:
        type(self).orders = []

    def run(self, commands: Iterable[Command]) -> Iterator[JobResult]:
        for command in commands:
            command.add_to_log("")
            self.orders.append(command.order)
            measure_shard(self.work, command.order[-1])
            yield JobResult(command.name)


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> type[InThisProcess]:
    InThisProcess.orders = []
    monkeypatch.setattr(ahead, "Processes", InThisProcess)
    return InThisProcess


@pytest.mark.parametrize("shards", [1, 3, 8, 40])
def test_every_piece_is_in_one_shard(shards: int, tmp_path: Path) -> None:
    done = list[int]()
    work = [
        Piece(f"game{number % 3}", lambda number=number: done.append(number), tmp_path, "")  # type: ignore[misc]
        for number in range(23)
    ]
    for shard in range(1, shards + 1):
        before = len(done)
        measure_shard(work, f"{shard}/{shards}")
        games = [number % 3 for number in done[before:]]
        assert games == sorted(games)
    assert sorted(done) == list(range(23))


def test_what_cannot_be_measured_is_left_to_the_report(tmp_path: Path) -> None:
    def refuse() -> None:
        raise ValueError("too short")

    work = [Piece("a", refuse, tmp_path, "none"), *pieces(tmp_path, 2)]
    measure_shard(work, "1/1")
    assert [piece.is_missing for piece in work] == [True, False, False]


def test_the_workers_are_handed_all_that_is_missing(
    tmp_path: Path, engine: type[InThisProcess]
) -> None:
    engine.work = pieces(tmp_path / "kept", ahead.FEWEST)
    told = list[tuple[str, int, int]]()
    options = ["--skip", "beliefs"]
    measure_ahead(engine.work, StudyFolder(tmp_path), options, 2, lambda *words: told.append(words))
    assert not any(piece.is_missing for piece in engine.work)
    assert {tuple(order[:-2]) for order in engine.orders} == {("report", str(tmp_path), *options)}
    assert told[-1] == ("measures", 2 * ahead.SHARES, 2 * ahead.SHARES)
    assert not (tmp_path / "logs" / "report.log").exists()  # nothing was said
    measure_ahead(engine.work, StudyFolder(tmp_path), options, 2, None)
    assert len(engine.orders) == 2 * ahead.SHARES  # all was kept: nothing is begun again


@pytest.mark.parametrize(("workers", "count"), [(1, ahead.FEWEST), (2, ahead.FEWEST - 1)])
def test_one_process_and_a_few_pieces_start_no_other(
    workers: int, count: int, tmp_path: Path, engine: type[InThisProcess]
) -> None:
    work = pieces(tmp_path / "kept", count)
    measure_ahead(work, StudyFolder(tmp_path), [], workers, None)
    assert not engine.orders and all(piece.is_missing for piece in work)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--shard", "3/2"], "a shard is written 3/10"),
        (["--workers", "-1"], "workers must be at least 1"),
    ],
)
def test_a_shard_or_a_number_that_there_is_not_is_refused(
    words: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["report", str(tmp_path), *words]) == cli.EXIT_BAD_INPUT
    assert reason in capsys.readouterr().err


def contents(folder: Path) -> dict[str, Any]:
    """The arrays that a study keeps, as bytes, and its page without the time and the folder."""
    kept = dict[str, Any]()
    for file in sorted(folder.glob("runs/*/analysis/*.npz")):
        with np.load(file, allow_pickle=False) as arrays:
            for name, array in arrays.items():
                kept[f"{file.parent.parent.name} {file.name} {name}"] = array.tobytes()
    page = (folder / "report.html").read_text()
    page = page.replace("study-a", "").replace("study-b", "")  # in commands
    kept["page"] = [line for line in page.splitlines() if "written" not in line.lower()]
    return kept


@pytest.mark.slow
def test_the_page_is_the_same_however_many_processes_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "toy.toml").write_text(TOML)
    words = ["study", str(tmp_path / "toy.toml"), "--out", str(tmp_path / "study-a")]
    assert cli.main([*words, "--engine", "inline", "--no-report"]) == 0
    monkeypatch.setattr(ahead, "FEWEST", 1)
    shutil.copytree(tmp_path / "study-a", tmp_path / "study-b")
    report(tmp_path / "study-a", skip=("references",), workers=1)
    told = list[str]()
    report(
        tmp_path / "study-b",
        skip=("references",),
        workers=2,
        progress=lambda name, done, total: told.append(name),
    )
    assert "measures" in told
    alone = contents(tmp_path / "study-a")
    assert len(alone) > 20
    assert alone == contents(tmp_path / "study-b")
