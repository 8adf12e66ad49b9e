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
from itertools import chain
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np

from arcade_torch.agents.runs.files import open_regular, read_csv, read_text, write_atomic
from arcade_torch.agents.runs.shipped import is_shipped
from arcade_torch.tools.errors import need
from arcade_torch.tools.text import csv_cell, markdown_cell, printable

NARROWEST = 40
"""Columns of a terminal below which a table is wider than it."""
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
        lines = list[list[str]]()
        for line in (self.columns, *self.rows):
            lines.append([_lines(cell) for cell in line])
        widths = [_width(cells) for cells in zip(*lines, strict=True)]
        console = need("rich.console").Console
        terminal = sys.stdout.isatty() or "COLUMNS" in os.environ
        width = max(console().width if terminal else sum(widths) + 1, NARROWEST)
        if sum(widths) + 1 > width:  # a long name goes on in the next line
            widths[0] = min(widths[0], width // 2)
        parts = self._parts(widths, width)
        for part in parts:
            title = _lines(self.title) if part is parts[0] else ""
            caption = _lines(self.caption) if part is parts[-1] else ""
            table = need("rich.table").Table(title=title or None, caption=caption or None)
            table.title_justify = "left"
            table.caption_justify = "left"
            for column in part:
                side = "left" if column < self.left else "right"
                most = widths[0] - 3 if column == 0 else None
                table.add_column(lines[0][column], justify=side, overflow="fold", max_width=most)
            for line in lines[1:]:
                table.add_row(*(line[column] for column in part))
            console(highlight=False, markup=False, emoji=False, width=width).print(table)

    def _parts(self, widths: Sequence[int], width: int) -> list[list[int]]:
        """The columns of tables that are no wider than a terminal; those that name a row are in
        all of them.
        """
        names = list(range(self.left))
        parts = [list(names)]
        for column in range(self.left, len(widths)):
            wider = sum(widths[other] for other in parts[-1]) + widths[column] + 1
            if wider > width and len(parts[-1]) > self.left:
                parts.append(list(names))
            parts[-1].append(column)
        return parts


def _width(cells: Sequence[str]) -> int:
    """Letters that a column takes, with its frame."""
    lines = "\n".join(cells).split("\n")
    return max(map(len, lines)) + 3


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
    lines = []
    for cells in (columns, *rows):
        lines.append("| " + " | ".join(map(markdown_cell, cells)) + " |")
    lines.insert(1, "|---" * left + "|---:" * (len(columns) - left) + "|")
    return "\n".join(lines)


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
    before = old.partition(begin)[0]
    after = old.partition(end)[2]
    return write_atomic(page, f"{before}{begin}\n\n{text}\n\n{end}{after}")


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> Path:
    """Write rows as CSV atomically; see `csv_text`."""
    return write_atomic(path, csv_text(rows, columns))


def csv_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """Rows as CSV, by default with every column that one has; a missing key or None gives an empty
    cell.
    """
    buffer = io.StringIO()
    names = list(columns or dict.fromkeys(chain.from_iterable(rows)))
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([csv_cell(name) for name in names])
    for row in rows:
        writer.writerow([csv_cell(row.get(name, "")) for name in names])
    return buffer.getvalue()


def read_rows(path: Path, kind: type[Row]) -> list[Row]:
    """Rows of a CSV file as named tuples of a kind; a ``ValueError`` if it is no table of them."""
    rows = list[Row]()
    try:
        for cells in read_csv(path):
            values = [convert(cells[name]) for name, convert in kind.__annotations__.items()]
            rows.append(kind(*values))
    except (KeyError, ValueError) as error:
        wanted = ", ".join(kind._fields)
        raise ValueError(f"{path} is no table with columns {wanted} ({error})") from None
    return rows


def measured_rows(
    path: Path | None, kind: type[Row], keys: Iterable[tuple[Any, ...]], measure: Callable[..., Row]
) -> Iterator[Row]:
    """The row of every key, its first cells: those that a CSV file holds, the others measured and
    added to it.

    ``measure`` is called with the cells of a key; without a ``path`` nothing is kept.
    """
    rows = read_rows(path, kind) if path is not None and path.exists() else []
    for key in keys:
        row = next((row for row in rows if row[: len(key)] == key), None)
        if row is None:
            row = measure(*key)
            rows.append(row)
            if path is not None:
                write_csv(path, [other._asdict() for other in rows], kind._fields)
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
                return dict(arrays)
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
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(member)
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
    they stand as JSON in ``options`` of the arrays. What is no run folder (a single checkpoint, an
    agent of this package), or cannot be written, keeps nothing.
    """
    text = json.dumps(dict(options), sort_keys=True)
    file = run / "analysis" / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}.npz"
    kept = _kept_arrays(file, text)
    if kept is not None:
        return kept
    arrays = compute()
    arrays["options"] = np.array(text)
    keeps = (run / "config.json").is_file() and not is_shipped(run)
    if keeps and os.access(run, os.W_OK) and not file.parent.is_symlink():
        try:
            write_npz(file, arrays | {"layout": np.array(_layout(arrays))})
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
    layout = dict[str, Any]()
    for name, value in arrays.items():
        layout[name] = [str(np.asarray(value).dtype), np.shape(value)]
    return json.dumps(layout, sort_keys=True)
