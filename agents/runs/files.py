"""Small files of a run: replaced atomically, or tables that grow by whole rows."""

import csv
import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


class CheckpointError(RuntimeError):
    """A checkpoint is missing, damaged, of another format, or of another run."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # names of files may have line breaks


def write_atomic(path: Path, text: str) -> None:
    """Replace a text file in one step: readers see the old content or the new, never a part."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except BaseException:  # a full disk, for one
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Replace a JSON file in one step."""
    write_atomic(path, json.dumps(value, indent=1) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file; a ``ValueError`` if it does not hold JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # no text, no JSON, too many digits, nested too deeply
        raise ValueError(f"{path} does not hold JSON: {error}") from error


def checksum(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def is_final(values: Any, needed: Sequence[str] = ()) -> bool:
    """Whether ``values``, with all ``needed`` keys, is what the ``eval.json`` of a finished run holds."""
    if not isinstance(values, dict) or values.get("status", "finished") != "finished" or not set(needed) <= set(values):
        return False
    returns, lengths = values.get("returns", []), values.get("lengths", [])
    if not all(isinstance(part, list) and all(map(_is_number, part)) for part in (returns, lengths)):
        return False
    if not all(isinstance(length, int) for length in lengths) or not _is_number(values.get("mean", 0 if returns else None)):
        return False
    optional = ("std", "ci", "n", "frames", "seconds", "train_max_ewm")
    return all(values.get(name) is None or _is_number(values[name]) for name in optional)


def _is_number(value: Any) -> bool:
    """Whether a value is a number that can be squared; NaN is one."""
    return isinstance(value, int | float) and not isinstance(value, bool) and not abs(value) > 1e15


class CsvLog:
    """A table, first column ``frames``, that grows by whole rows; on opening, what is beyond ``keep_frames`` is dropped."""

    def __init__(self, path: Path, columns: Sequence[str], keep_frames: int = 0) -> None:
        self.path, self.columns = path, list(columns)
        rows = read_csv(path) if path.exists() else []
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


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a table (else ``ValueError``) whose first column is ``frames``, without unfinished or damaged ones."""
    try:
        text = path.read_text(encoding="utf-8")
        rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is damaged, it is no table: {error}") from error
    if not rows:
        return []
    header = rows[0]
    if header.count("frames") != 1 or header[0] != "frames":
        raise ValueError(f"{path} is damaged: its first line does not begin with 'frames'")
    whole = [row for row in rows[1:] if len(row) == len(header) and re.fullmatch("[0-9]{1,15}", row[0])]
    return [dict(zip(header, row, strict=True)) for row in whole]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.8g}" if isinstance(value, float) else str(value)
