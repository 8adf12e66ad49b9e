"""Checkpoints come from the hub that an entry names, by the SHA-256 in the entry, or not at all."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from arcade_torch.agents import hub
from arcade_torch.agents.hub import HubError
from arcade_torch.tools.board import pull as pulls
from arcade_torch.tools.board.check import check
from arcade_torch.tools.board.entry import EntryRefusedError, read_entry
from arcade_torch.tools.board.evaluation import Evaluator, Played
from arcade_torch.tools.board.page import _checked
from arcade_torch.tools.board.pull import folder_name, pull
from arcade_torch.tools.commands.leaderboard import Check
from tests.tools.board.boards import GAME, SHORT, plain_entry, write_pair

REPO = "somebody/checkpoints"
REVISION = "0123456789" * 4
NOTHING = Played(0.0, 0.0, 0.0, "0" * 64, 1, 1, ("pixels",))
"""What an agent that is not played scored."""


class EntryNotFoundError(Exception):
    """As the hub's client calls a file that is not there."""


class FolderHub:
    """The client of a hub whose one repository is a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.fetched: list[str] = []

    def hf_hub_url(self, repo: str, name: str, revision: str) -> str:
        assert (repo, revision) == (REPO, REVISION)
        return name

    def get_hf_file_metadata(self, url: str) -> SimpleNamespace:
        if not (self.folder / url).is_file():
            raise EntryNotFoundError(f"no {url}")
        return SimpleNamespace(size=(self.folder / url).stat().st_size, commit_hash=REVISION)

    def hf_hub_download(self, repo: str, name: str, revision: str) -> str:
        self.fetched.append(name)
        return str(self.folder / name)


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, FolderHub]:
    """The file of an entry whose two runs lie on a hub alone, and the hub."""
    monkeypatch.setattr(Evaluator, "play", lambda *_: NOTHING)
    write_pair(tmp_path / "trained", seed=1)
    plain: dict[str, Any] = plain_entry(tmp_path / "trained")
    plain["checkpoints"] = {"kind": "hub", "repo": REPO, "revision": REVISION}
    file = tmp_path / "entry.json"
    file.write_text(json.dumps(plain))
    entry = read_entry(file)
    for run in entry.runs:
        trained = tmp_path / "trained" / f"{GAME}-{run.twin}-mingru-1"
        shutil.move(trained, tmp_path / "hub" / folder_name(entry, run))
    client = FolderHub(tmp_path / "hub")
    monkeypatch.setattr(hub, "_package", lambda: client)
    return file, client


def test_runs_are_named_as_a_study_names_them(board: tuple[Path, FolderHub]) -> None:
    names = sorted(path.name for path in board[1].folder.iterdir())
    agent = "mingru__pqn__seed1"
    assert names == [f"MineSweeperEasy__{twin}__{agent}" for twin in ("full", "partial")]


def test_what_is_pulled_is_checked_and_pulled_once(
    board: tuple[Path, FolderHub], tmp_path: Path
) -> None:
    file, client = board
    record = check(file, tmp_path / "pulled", protocol=SHORT, weights="pulled")
    assert (record.runs, record.equal, record.weights) == (2, 2, "pulled")
    assert "2 of 2 pulled and evaluated again" in _checked(record)
    assert len(client.fetched) == 6 and not any("trainer" in name for name in client.fetched)
    check(file, tmp_path / "pulled", protocol=SHORT, weights="pulled")
    entry = read_entry(file)
    pull(entry, entry.runs, tmp_path / "pulled")
    assert len(client.fetched) == 6


@pytest.mark.parametrize("written", [1, 2])
def test_a_pull_that_was_cut_off_goes_on_with_whole_runs(
    board: tuple[Path, FolderHub], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """A run is there once its weights are: what else it needs has to be there before them."""
    entry = read_entry(board[0])
    write, left = pulls.write_atomic, [True] * written

    def write_some(file: Path, content: bytes) -> None:
        if not left:
            raise KeyboardInterrupt
        left.pop()
        write(file, content)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pulls, "write_atomic", write_some)
        pull(entry, entry.runs, tmp_path / "pulled")
    pull(entry, entry.runs, tmp_path / "pulled")
    for run in entry.runs:
        folder = tmp_path / "pulled" / folder_name(entry, run)
        names = {file.name for file in folder.rglob("*") if file.is_file()}
        assert names == {"config.json", "meta.json", "weights.safetensors"}


def test_runs_of_the_same_settings_with_other_weights_may_lie_beside_what_is_pulled(
    board: tuple[Path, FolderHub], tmp_path: Path
) -> None:
    """Runs that were trained again elsewhere: the check took them for what it had pulled."""
    file, client = board
    write_pair(tmp_path / "runs", seed=1)
    for weights in (tmp_path / "runs").rglob("weights.safetensors"):
        weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    check(file, tmp_path / "runs", protocol=SHORT, weights="pulled")
    assert len(client.fetched) == 6
    for folder in (tmp_path / "runs").glob("*__seed1"):
        folder.rename(folder.with_name(f"kept {folder.name}"))
    check(file, tmp_path / "runs", protocol=SHORT, weights="pulled")
    assert len(client.fetched) == 6


def test_other_weights_are_refused_before_anything_is_kept(
    board: tuple[Path, FolderHub], tmp_path: Path
) -> None:
    file, client = board
    weights = next(client.folder.glob("*__partial__*/checkpoints/*/weights.safetensors"))
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    entry = read_entry(file)
    with pytest.raises(EntryRefusedError, match=f"{GAME} partial, seed 1: the weights on the hub"):
        pull(entry, entry.runs, tmp_path / "pulled")
    assert [path.name for path in (tmp_path / "pulled").iterdir()] == [
        folder_name(entry, next(run for run in entry.runs if run.twin == "full"))
    ]


def test_files_that_are_missing_or_too_large_are_not_fetched(
    board: tuple[Path, FolderHub], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, client = board
    entry = read_entry(file)
    monkeypatch.setattr(pulls, "HEADER", 10)
    with pytest.raises(HubError, match=r"weights.safetensors of .* bytes, at most 26 are fetched"):
        pull(entry, entry.runs, tmp_path / "pulled")
    next(client.folder.glob("*__full__*/config.json")).unlink()
    with pytest.raises(HubError, match=r"config\.json of somebody/checkpoints: EntryNotFoundError"):
        pull(entry, entry.runs, tmp_path / "pulled")
    assert not (tmp_path / "pulled").exists()


@pytest.mark.parametrize(
    ("place", "advice"),
    [
        ({"kind": "retrain"}, "use --retrain"),
        ({"kind": "url", "url": "https://a.example/b"}, "from https://a.example/b by hand"),
    ],
)
def test_an_entry_without_a_hub_says_how_to_go_on(
    board: tuple[Path, FolderHub], tmp_path: Path, place: dict[str, str], advice: str
) -> None:
    file, client = board
    file.write_text(json.dumps(json.loads(file.read_text()) | {"checkpoints": place}))
    with pytest.raises(EntryRefusedError, match=advice):
        check(file, tmp_path, protocol=SHORT, weights="pulled")
    assert not client.fetched


def test_the_command_takes_one_way_to_get_runs(board: tuple[Path, FolderHub]) -> None:
    with pytest.raises(ValueError, match="--pull or --retrain, not both"):
        Check(board[0], runs=board[0].parent, pull=True, retrain=True).run()
    with pytest.raises(ValueError, match="with --pull they are fetched there"):
        Check(board[0], pull=True).run()
