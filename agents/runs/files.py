"""Small files of a run: read with a bound, replaced atomically, or tables that grow by whole rows."""

import csv
import hashlib
import io
import json
import os
import re
import secrets
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

MOST_TEXT = 256 * 2**20
"""Bytes of the largest text that is read: JSON, TOML, CSV."""
MOST_TENSORS = 16 * 2**30
"""Bytes of the largest file of tensors that is read."""
_DRAFT = re.compile(r"\..{1,40}\.\d+-[0-9a-f]{8}\.draft", re.DOTALL)


class CheckpointError(RuntimeError):
    """A checkpoint is missing, damaged, of another format, or of another run."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # names of files may have line breaks


def open_regular(path: Path, most_bytes: int = MOST_TEXT) -> BinaryIO:
    """Open a file for reading, if it is a regular one of a size that can be meant.

    What is opened is looked at, so that nothing can take its place in between; nothing is waited for.

    Args:
        path: the file, or a link to it.
        most_bytes: the largest size.

    Raises:
        FileNotFoundError, PermissionError: as ``open`` raises them.
        ValueError: it is a folder, a pipe, a socket or a device, or too large.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError(f"{path} is not a regular file")
        if status.st_size > most_bytes:
            raise ValueError(f"{path} has {status.st_size:,} bytes, at most {most_bytes:,} are read")
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: Path, most_bytes: int = MOST_TEXT) -> bytes:
    """What a regular file holds; raises as :func:`open_regular`."""
    with open_regular(path, most_bytes) as stream:
        return stream.read(most_bytes)


def read_text(path: Path) -> str:
    """What a regular file of text in UTF-8 holds, without a byte order mark; a ``ValueError`` if it is no such file."""
    return read_bytes(path).decode("utf-8-sig")


def write_atomic(path: Path, data: str | bytes) -> Path:
    """Replace a file in one step: readers see the old content or the new, never a part; missing folders are made.

    Raises:
        OSError: it cannot be written; ``filename`` is ``path``, and the old content is still there.
    """
    # Others may write the same file on another machine; names may be as long as the system allows.
    draft = path.with_name(f".{path.name[:40]}.{os.getpid()}-{secrets.token_hex(4)}.draft")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_bytes(data.encode() if isinstance(data, str) else data)
        os.replace(draft, path)
    except OSError as error:  # a full disk, for one
        draft.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    return path


def remove_drafts(folder: Path) -> None:
    """Remove what :func:`write_atomic` of a killed process left in a folder, and nothing else."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if _DRAFT.fullmatch(path.name) and path.is_file() and not path.is_symlink():
            path.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> Path:
    """Replace a JSON file in one step."""
    return write_atomic(path, json.dumps(value, indent=1, default=str) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file; a ``ValueError`` if it does not hold JSON."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:  # no text, no JSON, too many digits, nested too deeply
        raise ValueError(f"{path} does not hold JSON: {error}") from error


def checksum(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    digest = hashlib.sha256()
    with open_regular(path, MOST_TENSORS) as stream:
        while block := stream.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def is_final(values: Any, needed: Sequence[str] = ()) -> bool:
    """Whether ``values``, with all ``needed`` keys, is what the ``eval.json`` of a finished run holds."""
    if not isinstance(values, dict) or values.get("status", "finished") != "finished" or not set(needed) <= set(values):
        return False
    returns, lengths = values.get("returns", []), values.get("lengths", [])
    if not (isinstance(returns, list) and isinstance(lengths, list)) or values.get("mean", returns or None) is None:
        return False
    others = [values.get(name) for name in ("mean", "std", "ci", "n", "frames", "seconds", "train_max_ewm")]
    numbers = [*returns, *lengths, *(value for value in others if value is not None)]
    sound = all(type(n) in (int, float) and not abs(n) > 1e15 for n in numbers)  # what can be squared; NaN is one
    return sound and all(type(n) is int for n in lengths)


class CsvLog:
    """A table, first column ``frames``, that grows by whole rows; on opening, what is beyond ``keep_frames`` is dropped."""

    def __init__(self, path: Path, columns: Sequence[str], keep_frames: int = 0) -> None:
        self.path, self.columns = path, list(columns)
        rows = read_csv(path, strict=False) if path.exists() else []
        kept = [[row.get(name, "") for name in columns] for row in rows if int(row["frames"]) <= keep_frames]
        write_atomic(path, "".join(",".join(cells) + "\n" for cells in [columns, *kept]))
        self._stream = path.open("a", newline="", encoding="utf-8")

    def append(self, row: Mapping[str, Any]) -> None:
        """Add one row and hand it to the operating system at once; None is written as an empty cell."""
        self._stream.write(",".join(_cell(row.get(name)) for name in self.columns) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def read_csv(path: Path, strict: bool = True) -> list[dict[str, str]]:
    """Rows of a table with a header.

    Args:
        path: the file.
        strict: refuse a line of another length; else the file is a log, its first column is ``frames``, and unfinished
            or damaged lines are left out.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no text, has no header or a name twice in it, or has such a line.
    """
    try:
        text = read_text(path)
        text = text if strict else text[: text.rfind("\n") + 1]
        header, *rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row] or [[]]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is {'not CSV in UTF-8' if strict else 'damaged, it is no table'}: {error}") from error
    if not strict:
        if header and (header.count("frames") != 1 or header[0] != "frames"):
            raise ValueError(f"{path} is damaged: its first line does not begin with 'frames'")
        rows = [row for row in rows if len(row) == len(header) and re.fullmatch("[0-9]{1,15}", row[0])]
    elif not header:
        raise ValueError(f"{path} is empty: expected CSV with a header line")
    elif len(set(header)) != len(header) or any(name.splitlines() not in ([name], []) for name in header):
        raise ValueError(f"{path} has a header that names a column twice, or over several lines")
    elif wrong := next((row for row in rows if len(row) != len(header)), None):
        which = "more" if len(wrong) > len(header) else "fewer"
        raise ValueError(f"{path} has a line with {which} cells than its header names")
    return [dict(zip(header, row, strict=True)) for row in rows]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.8g}" if isinstance(value, float) else str(value)
