"""What files of a run may cost to read, where appending may go, and which names are ours."""

import io
import os
import tracemalloc
from pathlib import Path

import pytest
import torch

from arcade_torch.agents import preset
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs import checkpoint as checkpoints
from arcade_torch.agents.runs import files
from arcade_torch.agents.runs.files import (
    CheckpointError,
    CsvLog,
    read_bytes,
    read_csv,
    read_json,
    read_log,
    write_json,
)
from arcade_torch.agents.runs.folder import RunFolder, RunFolderError

CONFIG: TrainConfig = preset("smoke")


def test_reading_a_small_file_takes_little_memory(tmp_path: Path) -> None:
    """Before: the largest size was reserved for each file, 16 GiB for weights of a byte."""
    path = tmp_path / "small"
    path.write_bytes(b"x")
    tracemalloc.start()
    try:
        assert read_bytes(path, files.MOST_TENSORS) == b"x"
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2**20


def test_a_table_of_too_many_lines_or_cells_is_refused(tmp_path: Path) -> None:
    """Before: 16 MiB of short lines took 2.5 GB."""
    path = tmp_path / "table.csv"
    path.write_bytes(b"a\n" + b"1\n" * (files.MOST_ROWS + 1))
    for read in (read_csv, read_log):
        with pytest.raises(ValueError, match="lines, at most 2,000,000 are read"):
            read(path)
    path.write_bytes(b"a\n" + b"1\r" * (files.MOST_ROWS + 1))
    with pytest.raises(ValueError, match="lines, at most"):
        read_csv(path)
    path.write_bytes(b"," * (files.MOST_CELLS + 1))
    with pytest.raises(ValueError, match="cells, at most"):
        read_csv(path)


def test_json_has_a_bound_of_its_own(tmp_path: Path) -> None:
    with (tmp_path / "a.json").open("wb") as sparse:
        sparse.truncate(files.MOST_JSON + 1)
    with pytest.raises(ValueError, match="bytes, at most 67,108,864 are read"):
        read_json(tmp_path / "a.json")


def test_a_refusal_says_once_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"^{tmp_path} is not a regular file$"):
        read_json(tmp_path)


# -- appending -------------------------------------------------------------------------------------


@pytest.mark.timeout(20)
def test_nothing_is_appended_to_a_pipe_a_device_or_a_link(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.write_text("mine")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(outside)
    (tmp_path / "device").symlink_to("/dev/full")
    for name in ("pipe", "folder", "link", "device"):
        with pytest.raises(ValueError, match=f"{name} is not a regular file"):
            files.open_append(tmp_path / name)
    assert outside.read_text() == "mine"
    with files.open_append(tmp_path / "new") as stream:
        stream.write(b"a")
    with files.open_append(tmp_path / "new") as stream:
        stream.write(b"b")
    assert (tmp_path / "new").read_bytes() == b"ab"


@pytest.mark.timeout(20)
def test_the_end_of_a_file_is_read_whatever_its_size(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as sparse:
        sparse.truncate(2**40)
        sparse.seek(0, os.SEEK_END)
        sparse.write(b"last \xff words\n")
    assert files.read_end(tmp_path / "log").endswith("last � words\n")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="not a regular file"):
        files.read_end(tmp_path / "pipe")


def test_a_log_that_could_not_be_written_closes_without_another_error(tmp_path: Path) -> None:
    log = CsvLog(tmp_path / "metrics.csv", ["frames"])
    log._stream.close()
    log._stream = open("/dev/full", "w")  # noqa: SIM115
    with pytest.raises(OSError, match="No space left") as caught:
        log.append({"frames": 1})
    assert caught.value.filename == str(tmp_path / "metrics.csv")
    log.close()


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lock", "tensorboard", "wandb", "wandb_id.txt"])
def test_a_run_follows_no_link_to_where_it_writes(tmp_path: Path, name: str) -> None:
    """Before: TensorBoard wrote behind the link; locks of filelock 3.12 empty the file behind
    theirs.
    """
    outside = tmp_path / "outside"
    outside.write_text("mine")
    run = tmp_path / "run"
    run.mkdir()
    (run / name).symlink_to(outside)
    with pytest.raises(RunFolderError, match=rf"{name} is a link"), RunFolder(run).claim(CONFIG):
        pass
    assert outside.read_text() == "mine"


def test_a_checkpoint_that_is_a_link_is_none(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    elsewhere = tmp_path / "elsewhere"
    whole = checkpoints.save_checkpoint(folder, CONFIG, 64, {"w": torch.zeros(2)}, {"frames": 64})
    whole.rename(elsewhere)
    whole.symlink_to(elsewhere)
    assert checkpoints.list_checkpoints(folder) == []
    again = checkpoints.save_checkpoint(folder, CONFIG, 64, {"w": torch.ones(2)}, {"frames": 64})
    assert not again.is_symlink() and checkpoints.load_checkpoint(again).weights["w"].sum() == 2
    assert sorted(path.name for path in elsewhere.iterdir()) == [
        "meta.json",
        "trainer.pt",
        "weights.safetensors",
    ]


@pytest.mark.parametrize("frames", [-1, 10**12, 10**400, True, "64", 64.0, None])
def test_a_checkpoint_counts_its_frames(tmp_path: Path, frames: object) -> None:
    path = checkpoints.save_checkpoint(tmp_path, CONFIG, 64, {"w": torch.zeros(2)}, {"frames": 64})
    meta = read_json(path / "meta.json")
    write_json(path / "meta.json", meta | {"frames": frames})
    with pytest.raises(CheckpointError, match=r"meta.json does not describe a run"):
        checkpoints.load_checkpoint(path)


@pytest.mark.parametrize("state", [None, [], torch.zeros(2), 5, "text"])
def test_a_state_that_is_no_table_is_damaged(tmp_path: Path, state: object) -> None:
    path = checkpoints.save_checkpoint(tmp_path, CONFIG, 64, {"w": torch.zeros(2)}, {"frames": 64})
    packed = io.BytesIO()
    torch.save(state, packed)
    (path / "trainer.pt").write_bytes(packed.getvalue())
    meta = read_json(path / "meta.json")
    meta["sha256"]["trainer.pt"] = files.checksum(path / "trainer.pt")
    write_json(path / "meta.json", meta)
    with pytest.raises(CheckpointError, match=r"trainer.pt cannot be read .*holds no table"):
        checkpoints.load_checkpoint(path)


def test_a_finished_run_that_may_not_be_read_is_not_evaluated_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("arcade_torch.agents.runs.folder.read_json", refuse)
    with pytest.raises(RunFolderError, match=r"eval.json may not be read: Permission denied"):
        RunFolder(tmp_path).finished()


# -- tensors ---------------------------------------------------------------------------------------


class Claim:
    """A few bytes that become something large when they are read."""

    def __init__(self, call: object, *arguments: object) -> None:
        self.reduced = (call, arguments)

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.reduced


def forged(folder: Path, part: str, data: bytes | None) -> Path:
    """A checkpoint with another part, and its checksum; without data a sparse file of 3 GiB."""
    path = checkpoints.save_checkpoint(folder, CONFIG, 64, {"w": torch.zeros(2)}, {"frames": 64})
    with (path / part).open("wb") as stream:
        stream.truncate(3 * 2**30) if data is None else stream.write(data)
    meta = read_json(path / "meta.json")
    meta["sha256"][part] = files.checksum(path / part) if data is not None else ""
    write_json(path / "meta.json", meta)
    return path


def test_weights_have_a_bound_of_their_own(tmp_path: Path) -> None:
    path = forged(tmp_path, "weights.safetensors", None)
    with pytest.raises(CheckpointError, match="bytes, at most 2,147,483,648 are read"):
        checkpoints.load_checkpoint(path)


@pytest.mark.parametrize("size", [10**12, 10**9])
def test_a_state_makes_nothing_but_tensors_and_tables(tmp_path: Path, size: int) -> None:
    """Before: torch's reader without pickle made bytes of any number that a file names."""
    packed = io.BytesIO()
    torch.save({"frames": 64, "a": Claim(bytearray, size)}, packed)
    path = forged(tmp_path, "trainer.pt", packed.getvalue())
    tracemalloc.start()
    try:
        with pytest.raises(
            CheckpointError, match=r"names .*bytearray, which is no part of a trainer's state"
        ):
            checkpoints.load_checkpoint(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2**24


def test_every_kind_of_tensor_is_a_part_of_a_state(tmp_path: Path) -> None:
    kinds = (
        torch.float32,
        torch.bfloat16,
        torch.float16,
        torch.int8,
        torch.uint8,
        torch.int64,
        torch.bool,
    )
    state = {str(kind): torch.ones(2, dtype=kind) for kind in kinds} | {
        "p": torch.nn.Parameter(torch.ones(2))
    }
    state |= {"kind": torch.float32, "size": torch.ones(2, 3).size(), "device": torch.device("cpu")}
    path = checkpoints.save_checkpoint(tmp_path, CONFIG, 64, {"w": torch.zeros(2)}, state)
    loaded = checkpoints.load_checkpoint(path).trainer
    assert loaded is not None and set(loaded) == set(state)
