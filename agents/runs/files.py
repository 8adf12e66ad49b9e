"""Small files of a run: read with a bound, replaced atomically, or tables that grow by whole
rows.
"""

import contextlib
import csv
import errno
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
"""Bytes of the largest text that is read, such as a table."""
MOST_JSON = 64 * 2**20
"""Bytes of the largest JSON that is read; in memory it may take thirty times as much."""
MOST_ROWS = 2_000_000
"""Lines of the longest table that is read; in memory a short line takes a hundred times as much."""
MOST_CELLS = 2**25
"""Cells of the largest table that is read."""
MOST_TENSORS = 16 * 2**30
"""Bytes of the largest file of tensors that is read."""
LATEST = "latest"
"""File in ``checkpoints/`` with the name of the newest."""
_END_BYTES = 2**16
_OUR_NAMES = {
    "draft": re.compile(r"\..{1,40}\.\d+-[0-9a-f]{8}\.draft", re.DOTALL),
    "window": re.compile(r"window-\d{9,12}\.safetensors", re.ASCII),
    "checkpoint": re.compile(r"frames-\d{12}", re.ASCII),
    "checkpoint draft": re.compile(r"\.frames-\d{12}\.\d+", re.ASCII),
}


class CheckpointError(RuntimeError):
    """A checkpoint is missing, damaged, of another format, or of another run."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # names of files may have line breaks


def is_our_name(name: object, kind: str) -> bool:
    """Whether a name is one that we give: to a ``draft``, a ``window``, a ``checkpoint`` or a
    ``checkpoint draft``.

    Whatever reads, lists or removes files by names that stand in a file or a folder asks here.
    """
    return isinstance(name, str) and _OUR_NAMES[kind].fullmatch(name) is not None


def is_ours(path: Path, kind: str) -> bool:
    """Whether a path has a name that we give, and is what we make of it: a file or a folder, and no
    link.
    """
    if not is_our_name(path.name, kind) or path.is_symlink():
        return False
    return path.is_dir() if kind.startswith("checkpoint") else path.is_file()


def is_inside(folder: Path, name: str) -> bool:
    """Whether a relative name leads to a place for a file below a folder, through no link and
    nothing upwards.
    """
    parts = name.split("/")
    if "\0" in name or any(part in ("", ".", "..") for part in parts):
        return False
    places = [folder.joinpath(*parts[:length]) for length in range(1, len(parts))]
    return not any(place.is_symlink() for place in places)


def open_regular(path: Path, most_bytes: int | None) -> BinaryIO:
    """Open a file for reading, if it is a regular one of a size that can be meant.

    What is opened is looked at, so that nothing can take its place in between; nothing is waited
    for.

    Args:
        path: the file, or a link to it.
        most_bytes: the largest size; None for any.

    Raises:
        FileNotFoundError, PermissionError: as ``open`` raises them.
        ValueError: it is a folder, a pipe, a socket or a device, or too large.
    """
    stream = _open(path, os.O_RDONLY, "rb")
    size = os.fstat(stream.fileno()).st_size
    if most_bytes is not None and size > most_bytes:
        stream.close()
        raise ValueError(f"{path} has {size:,} bytes, at most {most_bytes:,} are read")
    return stream


def open_append(path: Path) -> BinaryIO:
    """Open a file to write at its end; it is made if there is none.

    Raises:
        OSError: as ``open`` raises it.
        ValueError: it is a link, a folder, a pipe, a socket or a device.
    """
    try:
        return _open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, "ab")
    except OSError as error:
        if error.errno not in (errno.ENXIO, errno.ELOOP, errno.EISDIR):
            raise
        raise ValueError(f"{path} is not a regular file") from error


def _open(path: Path, flags: int, mode: str) -> BinaryIO:
    """Open a regular file; nothing is waited for."""
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError(f"{path} is not a regular file")
        stream: Any = os.fdopen(descriptor, mode)
    except BaseException:
        os.close(descriptor)
        raise
    return stream  # type: ignore[no-any-return]


def read_bytes(path: Path, most_bytes: int = MOST_TEXT) -> bytes:
    """What a regular file holds; raises as :func:`open_regular`."""
    with open_regular(path, most_bytes) as stream:
        size = os.fstat(stream.fileno()).st_size
        return stream.read(size)  # not most_bytes, which would be reserved


def read_text(path: Path, most_bytes: int = MOST_TEXT) -> str:
    """What a regular file of text in UTF-8 holds, without a byte order mark; a ``ValueError`` if it
    is no such file.
    """
    return read_bytes(path, most_bytes).decode("utf-8-sig")


def read_end(path: Path) -> str:
    """The last 64 KiB of a regular file of any size, as text; raises as :func:`open_regular`."""
    with open_regular(path, None) as stream:
        size = os.fstat(stream.fileno()).st_size
        stream.seek(max(0, size - _END_BYTES))
        return stream.read(_END_BYTES).decode("utf-8", errors="replace")


def write_atomic(path: Path, data: str | bytes) -> Path:
    """Replace a file in one step: readers see the old content or the new, never a part; missing
    folders are made.

    What of a text has no UTF-8 (names of files may be any bytes) is written with backslashes.

    Raises:
        OSError: it cannot be written; ``filename`` is ``path``, and the old content is still there.
            A pipe or a device, also behind a link, is no file to replace.
    """
    _refuse_special(path)
    # Others may write the same file on another machine; names may be as long as the system allows.
    draft = path.with_name(f".{path.name[:40]}.{os.getpid()}-{secrets.token_hex(4)}.draft")
    try:
        _make_folder(path)
        draft.write_bytes(data.encode(errors="backslashreplace") if isinstance(data, str) else data)
        os.replace(draft, path)
    except OSError as error:  # a full disk, for one
        with contextlib.suppress(OSError):  # nor is there a draft on a disk that takes no files
            draft.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    return path


def check_writable(path: Path) -> Path:
    """Refuse a file that :func:`write_atomic` could not write, before the work for it begins.

    Raises:
        OSError: it is a folder, a pipe or a device, what should be its folder is a file, or nobody
            may write there; ``filename`` is ``path``.
    """
    _refuse_special(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder: choose a file", str(path))
    check_writable_folder(path.parent, path)
    return path


def check_writable_folder(folder: Path, path: Path | None = None) -> Path:
    """The same of a folder that is there, or is made; ``path`` is what the error names."""
    name = str(folder if path is None else path)
    place = _nearest_place(folder)
    if not place.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, f"{place} is a file, not a folder", name)
    if not os.access(place, os.W_OK | os.X_OK):
        number = errno.EROFS if _is_read_only(place) else errno.EACCES
        raise OSError(number, os.strerror(number), name)
    return folder


def _nearest_place(folder: Path) -> Path:
    """The folder, or the nearest one above it that is there; or a file in its place."""
    place = folder
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    return place


def _is_read_only(place: Path) -> bool:
    return bool(os.statvfs(place).f_flag & os.ST_RDONLY)


def _refuse_special(path: Path) -> None:
    """Refuse to replace a pipe, a socket or a device, or a link to one."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:  # such as a name that is too long
        raise OSError(error.errno, error.strerror, str(path)) from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FileExistsError(errno.EEXIST, "it is a pipe or a device, not a file", str(path))


def _make_folder(path: Path) -> None:
    """Make the folder of a file."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        check_writable_folder(path.parent, path)
        raise


def remove_drafts(folder: Path) -> None:
    """Remove what :func:`write_atomic` of a killed process left in a folder, and nothing else."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if is_ours(path, "draft"):
            path.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> Path:
    """Replace a JSON file in one step."""
    return write_atomic(path, json.dumps(value, indent=1, default=str) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file; a ``ValueError`` if it does not hold JSON."""
    data = read_bytes(path, MOST_JSON)
    try:
        return json.loads(data.decode("utf-8-sig"))
    # no text, no JSON, too many digits, nested too deeply
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} does not hold JSON: {error}") from error


def checksum(path: Path, most_bytes: int = MOST_TENSORS) -> str:
    """SHA-256 of a regular file, hexadecimal; raises as :func:`open_regular`."""
    digest = hashlib.sha256()
    with open_regular(path, most_bytes) as stream:
        while block := stream.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints in a ``checkpoints/`` folder, the newest (by ``latest``, then by frames)
    first.
    """
    checkpoints = [path for path in folder.glob("frames-*") if is_ours(path, "checkpoint")]
    latest = latest_name(folder)
    checkpoints.sort(reverse=True)
    return sorted(checkpoints, key=lambda path: path.name != latest)


def latest_name(folder: Path) -> str:
    """The name in ``latest`` of a ``checkpoints/`` folder; empty if none of a checkpoint is."""
    try:
        name = read_text(folder / LATEST).strip()
    except (OSError, ValueError):
        return ""
    return name if is_our_name(name, "checkpoint") else ""


class CsvLog:
    """A table, first column ``frames``, that grows by whole rows; on opening, what is beyond
    ``keep_frames`` is dropped.
    """

    def __init__(self, path: Path, columns: Sequence[str], keep_frames: int = 0) -> None:
        self.path = path
        self.columns = list(columns)
        rows = read_log(path) if path.exists() else []
        kept = [
            [row.get(name, "") for name in columns]
            for row in rows
            if int(row["frames"]) <= keep_frames
        ]
        write_atomic(path, "".join(",".join(cells) + "\n" for cells in [columns, *kept]))
        self._stream = io.TextIOWrapper(open_append(path), encoding="utf-8", newline="")

    def append(self, row: Mapping[str, Any]) -> None:
        """Add one row and hand it to the operating system at once; None is written as an empty
        cell.
        """
        try:
            self._stream.write(",".join(_cell(row.get(name)) for name in self.columns) + "\n")
            self._stream.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def close(self) -> None:
        """Close the file; what could not be written before, and was told then, is left out."""
        with contextlib.suppress(OSError):
            self._stream.close()


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a table with a header.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no text, has no header or a name twice in it, or has a line of another
            length.
    """
    lines = _read_cells(path, "not CSV in UTF-8")
    if not lines:
        raise ValueError(f"{path} is empty: expected CSV with a header line")
    header, *rows = lines
    on_one_line = all(name.splitlines() in ([name], []) for name in header)
    if len(set(header)) != len(header) or not on_one_line:
        raise ValueError(f"{path} has a header that names a column twice, or over several lines")
    for row in rows:
        if len(row) != len(header):
            which = "more" if len(row) > len(header) else "fewer"
            raise ValueError(
                f"{path} has a line with {which} cells than its header names{_divided(header)}"
            )
    return [dict(zip(header, row, strict=True)) for row in rows]


def read_log(path: Path) -> list[dict[str, str]]:
    """Rows of a table that a `CsvLog` adds to; lines that are unfinished or damaged are left out.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no text, or its first column is not ``frames``.
    """
    lines = _read_cells(path, "damaged, it is no table", unfinished=False)
    if not lines:
        return []
    header, *rows = lines
    if header[0] != "frames" or header.count("frames") != 1:
        raise ValueError(f"{path} is damaged: its first line does not begin with 'frames'")
    whole = []
    for row in rows:
        if len(row) == len(header) and re.fullmatch("[0-9]{1,15}", row[0]):
            whole.append(dict(zip(header, row, strict=True)))
    return whole


def _read_cells(path: Path, wrong: str, unfinished: bool = True) -> list[list[str]]:
    """The cells of all lines that are not empty; with a last one that is ``unfinished``, or
    without.
    """
    try:
        text = read_text(path)
        _check_size(path, text)
        if not unfinished:
            text = text[: text.rfind("\n") + 1]
        return [row for row in csv.reader(io.StringIO(text, newline="")) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is {wrong}: {error}") from error


def _divided(header: Sequence[str]) -> str:
    """A hint where a spreadsheet has divided the cells by something else than commas."""
    marks = {";": "semicolons", "\t": "tabs"}
    used = [words for mark, words in marks.items() if any(mark in name for name in header)]
    return f": it is divided by {used[0]}, wanted are commas" if used else ""


def _check_size(path: Path, text: str) -> None:
    """Refuse a table that would take far more memory than its file has bytes."""
    lines = text.count("\n") + text.count("\r")
    cells = lines + text.count(",")
    if lines > MOST_ROWS:
        raise ValueError(f"{path} has {lines:,} lines, at most {MOST_ROWS:,} are read")
    if cells > MOST_CELLS:
        raise ValueError(f"{path} has {cells:,} cells, at most {MOST_CELLS:,} are read")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.8g}" if isinstance(value, float) else str(value)
