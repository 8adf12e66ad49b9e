"""Pages, tables and arrays as files of studies, analyses and figures; see also `arcade_torch.agents.runs.files`."""

import csv
import hashlib
import io
import json
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from arcade_torch.agents.runs.files import read_csv, write_atomic

__all__ = ["cached_arrays", "csv_text", "read_csv", "write_between", "write_csv", "write_npz"]


def write_between(page: Path, begin: str, end: str, text: str) -> Path:
    """Put text between two marks of a page, in the place of what stood there."""
    try:
        old = page.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{page} is not text in UTF-8: {error}") from error
    if old.count(begin) != 1 or old.count(end) != 1 or old.index(begin) > old.index(end):
        raise ValueError(f"{page} needs one line {begin!r} and below it one line {end!r}; the table goes between them")
    return write_atomic(page, f"{old.partition(begin)[0]}{begin}\n\n{text}\n\n{end}{old.partition(end)[2]}")


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> Path:
    """Write rows as CSV atomically; see `csv_text`."""
    return write_atomic(path, csv_text(rows, columns))


def csv_text(rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """Rows as CSV; a missing key or None gives an empty cell."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def write_npz(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Write arrays atomically and compressed."""
    import numpy as np

    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return write_atomic(path, buffer.getvalue())


def cached_arrays(
    run: Path, name: str, options: Mapping[str, Any], compute: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """Arrays from ``run/analysis``, computed and written there if they are missing, made for others, or damaged.

    ``options`` are JSON values and everything that decides the numbers, the checkpoint included; they stand as JSON in
    ``options`` of the arrays. What is no run folder (a single checkpoint), or cannot be written, keeps nothing.
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
