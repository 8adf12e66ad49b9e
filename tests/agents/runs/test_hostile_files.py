"""Files of a run that somebody else made, or that cannot be written: refused in one line, and
nothing is harmed.
"""

import errno
import io
import os
import socket
import stat
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import preset
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.replay import SequenceReplay
from arcade_torch.agents.runs import checkpoint as checkpoints
from arcade_torch.agents.runs import files
from arcade_torch.agents.runs.files import (
    CheckpointError,
    checksum,
    read_csv,
    read_json,
    read_log,
    write_atomic,
    write_json,
)
from arcade_torch.agents.runs.folder import RunFolder, RunFolderError
from tests.agents.fakes import stream

CONFIG: TrainConfig = preset("smoke")
READERS = {
    "json": read_json,
    "csv": read_csv,
    "log": read_log,
    "sum": checksum,
}


def fifo(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def listener(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


@pytest.mark.timeout(20)
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", [fifo, device, Path.mkdir, listener])
def test_what_is_no_regular_file_is_refused_at_once(
    tmp_path: Path, kind: object, reader: str
) -> None:
    """Before: a pipe was waited for, for ever, and /dev/zero was read until memory ended."""
    path = tmp_path / "file"
    kind(path)  # type: ignore[operator]
    with pytest.raises((ValueError, OSError)) as caught:
        READERS[reader](path)
    assert "not a regular file" in str(caught.value) or isinstance(caught.value, OSError)


@pytest.mark.parametrize("reader", ["json", "csv", "log"])
def test_a_text_beyond_all_measure_is_refused_unread(tmp_path: Path, reader: str) -> None:
    path = tmp_path / "file"
    with path.open("wb") as sparse:
        sparse.truncate(files.MOST_TEXT + 1)
    with pytest.raises(ValueError, match=r"bytes, at most (67,108,864|268,435,456) are read"):
        READERS[reader](path)


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": 1}', encoding="utf-8-sig")
    (tmp_path / "a.csv").write_text("a,b\n1,2\n", encoding="utf-8-sig")
    assert read_json(tmp_path / "a.json") == {"a": 1}
    assert read_csv(tmp_path / "a.csv") == [{"a": "1", "b": "2"}]


# -- names -----------------------------------------------------------------------------------------


def replay(folder: Path) -> SequenceReplay:
    out = SequenceReplay(100, folder)
    out.add(stream(2, 5, seed=1).sequences())
    return out


@pytest.mark.parametrize(
    "name", ["{outside}", "../outside", "window-1.safetensors", "sub/window-000000000.safetensors"]
)
def test_a_forged_name_reaches_no_file_outside(tmp_path: Path, name: str) -> None:
    """Before: an absolute name, or one with .., was opened, and removed when the replay was
    full.
    """
    outside = tmp_path / "outside"
    made = replay(tmp_path / "run" / "replay")
    state = made.state_dict()
    outside.write_bytes((tmp_path / "run/replay/window-000000000.safetensors").read_bytes())
    forged = {"files": {name.format(outside=outside): checksum(outside)}, "added": 1}
    with pytest.raises(CheckpointError, match="which is no window of a replay"):
        SequenceReplay(1, tmp_path / "run" / "replay").load_state_dict(forged)
    assert outside.is_file()
    for added in (-1, "1", True, 1.0, 10**12):
        with pytest.raises(ValueError, match="added must be a count"):
            SequenceReplay(1, tmp_path / "run" / "replay").load_state_dict(state | {"added": added})


def test_a_window_that_is_a_link_is_refused(tmp_path: Path) -> None:
    made = replay(tmp_path / "replay")
    state = made.state_dict()
    window = tmp_path / "replay" / "window-000000000.safetensors"
    window.rename(tmp_path / "elsewhere")
    window.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="is missing"):
        SequenceReplay(1, tmp_path / "replay").load_state_dict(state)


def test_only_windows_are_removed_from_a_replay(tmp_path: Path) -> None:
    made = replay(tmp_path)
    notes = [tmp_path / name for name in ("window-notes.txt", "window-1", "notes")]
    for path in notes:
        path.write_text("mine")
    old = tmp_path / "window-000000777.safetensors"
    old.write_text("of no checkpoint")
    made.state_dict()
    assert all(path.is_file() for path in notes) and not old.exists()


@pytest.mark.parametrize("name", ["checkpoints", "replay"])
def test_a_run_removes_nothing_behind_a_link(tmp_path: Path, name: str) -> None:
    other = tmp_path / "other"
    draft = other / ".frames-000000000064.12"
    draft.mkdir(parents=True)
    run = tmp_path / "run"
    run.mkdir()
    (run / name).symlink_to(other)
    with pytest.raises(RunFolderError, match=rf"{name} is a link"), RunFolder(run).claim(CONFIG):
        pass
    assert draft.is_dir()


def test_a_folder_of_another_name_is_no_checkpoint(tmp_path: Path) -> None:
    for name in ("frames-1", "frames-mine", "frames-000000000064.bak"):
        (tmp_path / name).mkdir()
    (tmp_path / "latest").write_text("../../etc")
    assert checkpoints.list_checkpoints(tmp_path) == []


# -- tensors ---------------------------------------------------------------------------------------


def saved(folder: Path) -> Path:
    weights = {"w": torch.zeros(2)}
    return checkpoints.save_checkpoint(folder, CONFIG, 64, weights, {"frames": 64})


def with_checksum(path: Path) -> None:
    meta = read_json(path / "meta.json")
    for name in meta["sha256"]:
        meta["sha256"][name] = checksum(path / name)
    write_json(path / "meta.json", meta)


def test_a_packed_state_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = saved(tmp_path)
    packed = io.BytesIO()
    with (
        zipfile.ZipFile(path / "trainer.pt") as archive,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as bomb,
    ):
        for entry in archive.namelist():
            bomb.writestr(entry, archive.read(entry))
        bomb.writestr("archive/data/9", bytes(2**24))
    (path / "trainer.pt").write_bytes(packed.getvalue())
    with_checksum(path)
    with pytest.raises(CheckpointError, match="is compressed"):
        checkpoints.load_checkpoint(path)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("part", ["weights.safetensors", "trainer.pt", "meta.json"])
def test_a_pipe_in_the_place_of_a_part_is_refused(tmp_path: Path, part: str) -> None:
    path = saved(tmp_path)
    (path / part).unlink()
    os.mkfifo(path / part)
    with pytest.raises(CheckpointError, match="not a regular file"):
        checkpoints.load_checkpoint(path)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", [fifo, device])
def test_a_pipe_in_the_place_of_a_config_is_refused(tmp_path: Path, kind: object) -> None:
    kind(tmp_path / "config.json")  # type: ignore[operator]
    with pytest.raises(RunFolderError, match="not a regular file"):
        RunFolder(tmp_path).check(CONFIG, resume=True)
    kind(tmp_path / "eval.json")  # type: ignore[operator]
    assert RunFolder(tmp_path).finished() is None


def test_what_may_not_be_read_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(tmp_path)

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(checkpoints, "checksum", refuse)
    with pytest.raises(CheckpointError, match="may not be read: Permission denied"):
        checkpoints.load_checkpoint(path)


# -- writing ---------------------------------------------------------------------------------------


def test_files_have_the_mode_of_the_umask(tmp_path: Path) -> None:
    """Before: weights could be read by their owner alone."""
    before = os.umask(0o027)
    try:
        path = saved(tmp_path / "checkpoints")
        write_atomic(tmp_path / "a", "text")
        replay(tmp_path / "replay")
    finally:
        os.umask(before)
    written = [tmp_path / "a", *path.iterdir(), *(tmp_path / "replay").iterdir()]
    assert len(written) == 5
    assert {stat.S_IMODE(file.stat().st_mode) for file in written} == {0o640}


def test_a_text_may_name_files_whose_names_are_no_utf_8(tmp_path: Path) -> None:
    """Before: a report of a folder with such a name ended in a UnicodeEncodeError."""
    name = os.fsdecode(b"run-\xff")
    page = write_atomic(tmp_path / "page.html", f"<p>{name}</p>")
    assert page.read_bytes() == rb"<p>run-\udcff</p>"


@pytest.mark.parametrize("where", ["write_bytes", "replace"])
def test_a_full_disk_names_the_file_and_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    path = tmp_path / "file.json"
    write_json(path, {"old": 1})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(*((Path, "write_bytes") if where == "write_bytes" else (os, "replace")), full)
        with pytest.raises(OSError, match="No space left on device") as caught:
            write_json(path, {"new": 2})
    assert caught.value.filename == str(path) and caught.value.errno == errno.ENOSPC
    assert read_json(path) == {"old": 1} and [entry.name for entry in tmp_path.iterdir()] == [
        "file.json"
    ]


def test_an_interruption_leaves_the_old_file_alone_in_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_json(tmp_path / "file.json", {"old": 1})

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            write_json(path, {"new": 2})
    assert read_json(path) == {"old": 1} and list(tmp_path.iterdir()) == [path]


def test_threads_may_replace_one_file_at_the_same_time(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    begin = threading.Barrier(4)

    def replace_often(number: int) -> None:
        begin.wait()
        for _ in range(100):
            write_json(path, [number] * 100)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(replace_often, range(4)))
    assert len(set(read_json(path))) == 1 and list(tmp_path.iterdir()) == [path]
