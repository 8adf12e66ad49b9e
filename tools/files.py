"""Reading and atomically writing the small files of studies, analyses and figures."""

import csv
import hashlib
import io
import json
import os
import secrets
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from arcade_torch.agents.runs.files import read_json

__all__ = ["cached_arrays", "read_csv", "read_json"]
__all__ += ["write_between", "write_bytes", "write_csv", "write_json", "write_npz", "write_text"]


def write_bytes(path: Path, data: bytes) -> Path:
    """Write a file so that a reader sees the old one or the new one, never half of it; missing folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{secrets.token_hex(8)}")  # others may write the same file on another machine
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return path


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text atomically; see `write_bytes`."""
    return write_bytes(path, text.encode())


def write_between(page: Path, begin: str, end: str, text: str) -> Path:
    """Put text between two marks of a page, in the place of what stood there."""
    try:
        old = page.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{page} is not text in UTF-8: {error}") from error
    if old.count(begin) != 1 or old.count(end) != 1 or old.index(begin) > old.index(end):
        raise ValueError(f"{page} needs one line {begin!r} and below it one line {end!r}; the table goes between them")
    return write_text(page, f"{old.partition(begin)[0]}{begin}\n\n{text}\n\n{end}{old.partition(end)[2]}")


def write_json(path: Path, value: Any) -> Path:
    """Write JSON atomically, indented, with a final newline."""
    return write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> Path:
    """Write rows as CSV atomically; a missing key or None gives an empty cell."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return write_text(path, buffer.getvalue())


def read_csv(path: Path) -> list[dict[str, str]]:
    """Read a CSV file with a header into one dict a line.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no text, has no header, a name twice in it, or a line of another length.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not CSV in UTF-8: {error}") from error
    if not header:
        raise ValueError(f"{path} is empty: expected CSV with a header line")
    if len(set(header)) != len(header) or any(name.splitlines() not in ([name], []) for name in header):
        raise ValueError(f"{path} has a header that names a column twice, or over several lines")
    for row in rows:
        if len(row) != len(header):
            which = "more" if len(row) > len(header) else "fewer"
            raise ValueError(f"{path} has a line with {which} cells than its header names")
    return [dict(zip(header, row, strict=True)) for row in rows]


def write_npz(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Write arrays atomically and compressed."""
    import numpy as np

    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return write_bytes(path, buffer.getvalue())


def cached_arrays(
    run: Path, name: str, options: Mapping[str, Any], compute: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """Arrays from ``run/analysis``, computed and written there if they are missing, made for others, or damaged.

    Args:
        run: run folder; anything else (a single checkpoint, a folder that cannot be written) keeps nothing.
        name: of the analysis.
        options: everything that decides the numbers, the checkpoint included; JSON values.
        compute: makes the arrays.

    Returns:
        The arrays, with the options as JSON in ``options``.
    """
    import numpy as np

    text = json.dumps(dict(options), sort_keys=True)
    file = run / "analysis" / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}.npz"
    try:
        with np.load(file, allow_pickle=False) as kept:
            arrays = {key: kept[key] for key in kept.files}
        if str(arrays["options"]) == text:
            return arrays
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        pass  # there is none, or it is damaged: it is made anew
    arrays = {**compute(), "options": np.array(text)}
    if (run / "config.json").is_file() and os.access(run, os.W_OK):
        write_npz(file, arrays)
    return arrays
