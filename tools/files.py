"""Tables: on the terminal, in Markdown, in files; arrays in files. See also
`arcade_torch.agents.runs.files`.
"""

import csv
import hashlib
import io
import json
import math
import os
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np

from arcade_torch.agents.runs.files import open_regular, read_text, write_atomic
from arcade_torch.agents.runs.files import read_csv as read_csv
from arcade_torch.tools.errors import need
from arcade_torch.tools.text import csv_cell, markdown_cell, printable

NARROWEST = 80
"""Columns of a terminal in which every table can be read."""
MOST_ARRAYS = 2 * 2**30
"""Bytes of the largest arrays that are read from a file, unpacked."""
Row = TypeVar("Row", bound=NamedTuple)


@dataclass(frozen=True)
class Table:
    """A table."""

    title: str  # above it
    columns: Sequence[str]  # headers
    rows: Sequence[Sequence[object]]  # cells; written with ``str``
    caption: str = ""  # below it
    left: int = 1  # how many columns are aligned left and name the row; the others are numbers

    def show(self) -> None:
        """Print it to stdout; a table that is wider than the terminal is cut into several, each
        with the names.
        """
        lines = [[_lines(cell) for cell in line] for line in (self.columns, *self.rows)]
        widths = [
            max(map(len, "\n".join(cells).split("\n"))) + 3 for cells in zip(*lines, strict=True)
        ]
        console = need("rich.console").Console
        terminal = sys.stdout.isatty() or "COLUMNS" in os.environ
        width = max(console().width if terminal else sum(widths) + 1, NARROWEST)
        parts = [list(range(self.left))]
        for i in range(self.left, len(self.columns)):
            if len(parts[-1]) > self.left and sum(widths[j] for j in (*parts[-1], i)) + 1 > width:
                parts.append(list(range(self.left)))
            parts[-1].append(i)
        for part in parts:
            title = _lines(self.title) if part is parts[0] else ""
            caption = _lines(self.caption) if part is parts[-1] else ""
            table = need("rich.table").Table(title=title or None, caption=caption or None)
            table.title_justify = table.caption_justify = "left"
            for i in part:
                table.add_column(
                    lines[0][i], justify="left" if i < self.left else "right", overflow="fold"
                )
            for line in lines[1:]:
                table.add_row(*(line[i] for i in part))
            console(highlight=False, markup=False, emoji=False, width=width).print(table)


def _lines(cell: object) -> str:
    """A cell as a terminal may show it; its own line breaks stay."""
    return "\n".join(map(printable, str(cell).split("\n")))


def format_value(value: Any) -> str:
    """A cell: numbers with four digits or in whole thousands."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value)


def markdown_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], left: int | None = None
) -> str:
    """A Markdown table; columns after the first ``left`` are aligned right."""
    left = len(columns) if left is None else left
    lines = ["| " + " | ".join(map(markdown_cell, line)) + " |" for line in (columns, *rows)]
    return "\n".join([lines[0], "|---" * left + "|---:" * (len(columns) - left) + "|", *lines[1:]])


def write_between(page: Path, begin: str, end: str, text: str) -> Path:
    """Put text between two marks of a page, in the place of what stood there."""
    try:
        old = read_text(page)
    except UnicodeDecodeError as error:
        raise ValueError(f"{page} is not text in UTF-8: {error}") from error
    if old.count(begin) != 1 or old.count(end) != 1 or old.index(begin) > old.index(end):
        raise ValueError(
            f"{page} needs one line {begin!r} and below it one line {end!r}; the table goes "
            "between them"
        )
    return write_atomic(
        page, f"{old.partition(begin)[0]}{begin}\n\n{text}\n\n{end}{old.partition(end)[2]}"
    )


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> Path:
    """Write rows as CSV atomically; see `csv_text`."""
    return write_atomic(path, csv_text(rows, columns))


def csv_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """Rows as CSV, by default with every column that one has; a missing key or None gives an empty
    cell.
    """
    buffer = io.StringIO()
    known = dict.fromkeys(name for row in rows for name in row)
    names = list(columns or known)
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([csv_cell(name) for name in names])
    for row in rows:
        writer.writerow([csv_cell(row.get(name, "")) for name in names])
    return buffer.getvalue()


def read_rows(path: Path, kind: type[Row]) -> list[Row]:
    """Rows of a CSV file as named tuples of a kind; a ``ValueError`` if it is no table of them."""
    try:
        return [
            kind(*(of(row[name]) for name, of in kind.__annotations__.items()))
            for row in read_csv(path)
        ]
    except (KeyError, ValueError) as error:
        wanted = ", ".join(kind._fields)
        raise ValueError(f"{path} is no table with columns {wanted} ({error})") from None


def measured_rows(
    path: Path | None, kind: type[Row], keys: Iterable[tuple[Any, ...]], measure: Callable[..., Row]
) -> Iterator[Row]:
    """The row of every key, its first cells: those that a CSV file holds, the others measured and
    added to it.

    ``measure`` is called with the cells of a key; without a ``path`` nothing is kept.
    """
    known = read_rows(path, kind) if path is not None and path.exists() else []
    for key in keys:
        row = next((row for row in known if row[: len(key)] == key), None)
        if row is None:
            known.append(row := measure(*key))
            if path is not None:
                write_csv(path, [each._asdict() for each in known], kind._fields)
        yield row


def write_npz(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Write arrays atomically and compressed."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return write_atomic(path, buffer.getvalue())


def read_npz(path: Path) -> dict[str, Any]:
    """Arrays from a file, after a look at what they claim to be: a small file may unpack to more
    than memory holds.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no regular file, no archive of plain arrays, or larger than
            ``MOST_ARRAYS``.
    """
    with open_regular(path, MOST_ARRAYS) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                total = sum(entry.file_size for entry in archive.infolist())
                if total > MOST_ARRAYS:
                    raise ValueError(
                        f"its arrays take {total:,} bytes, at most {MOST_ARRAYS:,} are read"
                    )
                for entry in archive.infolist():
                    with archive.open(entry) as member:
                        _check_header(member, entry.file_size)
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as arrays:
                return {key: arrays[key] for key in arrays.files}
        except (
            zipfile.BadZipFile,
            zlib.error,
            EOFError,
            NotImplementedError,
            RuntimeError,
            KeyError,
        ) as error:
            raise ValueError(f"{path} is no archive of arrays: {error}") from error
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _check_header(member: IO[bytes], size: int) -> None:
    """Refuse an array that claims to be larger than what is stored of it, or that holds objects."""
    version = np.lib.format.read_magic(member)
    read = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read(member)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > size:
        raise ValueError(
            f"an array claims to be {dtype} {list(shape)}, which is not what is stored"
        )


def cached_arrays(
    run: Path,
    name: str,
    options: Mapping[str, Any],
    compute: Callable[[], dict[str, Any]],
) -> dict[str, Any]:
    """Arrays from ``run/analysis``, computed and written there if they are missing, made for
    others, or damaged.

    ``options`` are JSON values and everything that decides the numbers, the checkpoint included;
    they stand as JSON in ``options`` of the arrays. What is no run folder (a single checkpoint), or
    cannot be written, keeps nothing.
    """
    text = json.dumps(dict(options), sort_keys=True)
    file = run / "analysis" / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}.npz"
    kept = _kept_arrays(file, text)
    if kept is not None:
        return kept
    arrays = {**compute(), "options": np.array(text)}
    if (run / "config.json").is_file() and os.access(run, os.W_OK) and not file.parent.is_symlink():
        try:
            write_npz(file, {**arrays, "layout": np.array(_layout(arrays))})
        # a full disk, for one: what took minutes to compute is still of use
        except OSError as error:
            warnings.warn(f"the numbers could not be kept for another time: {error}", stacklevel=2)
    return arrays


def _kept_arrays(file: Path, options: str) -> dict[str, Any] | None:
    """The arrays of a file, if they were made with these options and have the layout that was
    written.
    """
    try:
        arrays = read_npz(file)
    except (OSError, ValueError):  # there is none, or it is damaged
        return None
    layout = str(arrays.pop("layout", ""))
    fits = str(arrays.get("options", "")) == options and layout == _layout(arrays)
    return arrays if fits else None


def _layout(arrays: Mapping[str, Any]) -> str:
    """Names, types and shapes of arrays as text."""
    described = {
        name: [str(np.asarray(value).dtype), np.shape(value)] for name, value in arrays.items()
    }
    return json.dumps(described, sort_keys=True)
