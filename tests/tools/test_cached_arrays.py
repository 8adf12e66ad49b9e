"""Arrays of an analysis that stand in a file: used as they were written, else measured anew;
nothing else is read.
"""

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arcade_torch.tools import files
from arcade_torch.tools.files import cached_arrays, read_npz, write_npz


def measured(run: Path, calls: list[int]) -> dict[str, Any]:
    def compute() -> dict[str, Any]:
        calls.append(1)
        return {"deltas": np.arange(6.0).reshape(2, 3), "lengths": np.array([1, 2])}

    return cached_arrays(run, "recall", {"episodes": 2}, compute)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "config.json").write_text("{}")
    return tmp_path


def npz_of(run: Path) -> Path:
    (path,) = (run / "analysis").iterdir()
    return path


def test_what_was_measured_is_read_again(run: Path) -> None:
    calls: list[int] = []
    first = measured(run, calls)
    again = measured(run, calls)
    assert len(calls) == 1 and first.keys() == again.keys()
    assert all(np.array_equal(first[key], again[key]) for key in first)


CHANGES = {
    "a field less": lambda arrays: arrays.pop("deltas"),
    "another field": lambda arrays: arrays.update(other=np.zeros(3)),
    "another shape": lambda arrays: arrays.update(deltas=np.zeros((3, 2))),
    "another type": lambda arrays: arrays.update(lengths=np.array(["a", "b"])),
    "no layout": lambda arrays: arrays.pop("layout"),
    "other options": lambda arrays: arrays.update(options=np.array("{}")),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_was_changed_is_measured_anew(run: Path, change: str) -> None:
    """Before: TypeError or IndexError in the figure."""
    calls: list[int] = []
    first = measured(run, calls)
    arrays = dict(np.load(npz_of(run)))
    CHANGES[change](arrays)
    write_npz(npz_of(run), arrays)
    again = measured(run, calls)
    assert len(calls) == 2 and all(np.array_equal(first[key], again[key]) for key in first)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "text", "pickled", "empty"])
def test_what_is_no_archive_is_measured_anew(run: Path, kind: str) -> None:
    calls: list[int] = []
    measured(run, calls)
    path = npz_of(run)
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
        return  # nothing can take the place of a folder
    elif kind == "pickled":
        np.savez(path, deltas=np.array([{}], object))
    else:
        path.write_bytes(b"text" if kind == "text" else b"")
    measured(run, calls)
    assert len(calls) == 2


def archive(**members: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members.items():
            packed.writestr(f"{name}.npy", content)
    return out.getvalue()


def npy(header: str) -> bytes:
    text = header.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def test_an_array_that_claims_more_than_is_there_is_refused_before_memory_is_asked_for(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(
        archive(a=npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"))
    )
    with pytest.raises(ValueError, match=r"claims to be float64 \[1000000000000\]"):
        read_npz(path)


def test_an_archive_that_unpacks_to_more_than_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(2**20))
    monkeypatch.setattr(files, "MOST_ARRAYS", 2**20)
    assert path.stat().st_size < 2**20
    with pytest.raises(
        ValueError, match="its arrays take 8,388,736 bytes, at most 1,048,576 are read"
    ):
        read_npz(path)
