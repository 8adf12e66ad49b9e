"""Small files of a run: replaced atomically, or appended to and cut."""

import csv
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def write_atomic(path: Path, text: str) -> None:
    """Replace a text file in one step: readers see the old content or the new, never a part."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text)
        os.replace(temporary, path)
    except BaseException:  # a full disk, for one
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Replace a JSON file in one step."""
    write_atomic(path, json.dumps(value, indent=1) + "\n")


def checksum(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        ValueError: it does not hold JSON.
    """
    try:
        return json.loads(path.read_text())
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} does not hold JSON: {error}") from error


class CsvLog:
    """A table that grows by whole rows and can be cut back to a frame count.

    Args:
        path: file; created with a header if it does not exist.
        columns: names, the first is ``frames``.
        keep_frames: on opening, drop every row beyond this many frames, and every unfinished row; None keeps all.
    """

    def __init__(self, path: Path, columns: Sequence[str], keep_frames: int | None = None) -> None:
        self.path, self.columns = path, list(columns)
        if keep_frames is not None and path.exists():
            rows = [row for row in read_csv(path) if int(row["frames"]) <= keep_frames]
            lines = [",".join(self.columns), *(",".join(row.get(c, "") for c in self.columns) for row in rows)]
            write_atomic(path, "\n".join(lines) + "\n")
        elif not path.exists():
            write_atomic(path, ",".join(self.columns) + "\n")
        self._stream = path.open("a", newline="")

    def append(self, row: Mapping[str, Any]) -> None:
        """Add one row and hand it to the operating system at once; None is written as an empty cell."""
        self._stream.write(",".join(_cell(row.get(name)) for name in self.columns) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a table, without an unfinished or damaged last one."""
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    rows = list(csv.reader(whole.splitlines()))
    if not rows:
        return []
    header = rows[0]
    return [dict(zip(header, row, strict=True)) for row in rows[1:] if len(row) == len(header) and row[0].isdigit()]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.8g}" if isinstance(value, float) else str(value)
