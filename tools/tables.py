"""Tables on the terminal."""

import csv
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from arcade_torch.tools.optional import need

NARROWEST = 80
"""Columns of a terminal in which every table can be read."""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: above it.
        columns: headers.
        rows: cells; written with ``str``.
        caption: below it.
        left: how many columns are aligned left and name the row; the others are numbers.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    caption: str = ""
    left: int = 1

    def show(self) -> None:
        """Print it to stdout; a table that is wider than the terminal is cut into several, each with the names."""
        terminal = sys.stdout.isatty() or "COLUMNS" in os.environ
        width = max(need("rich.console").Console().width if terminal else self._width(), NARROWEST)
        console = need("rich.console").Console(highlight=False, markup=False, width=width)
        groups = self._groups(width)
        for number, group in enumerate(groups):
            last = number == len(groups) - 1
            console.print(self._part(group, self.title if not number else "", self.caption if last else ""))

    def _widths(self) -> list[int]:
        cells = [list(map(str, row)) for row in self.rows]
        return [
            max(len(line) for text in (name, *(row[i] for row in cells)) for line in (text.splitlines() or [""]))
            for i, name in enumerate(self.columns)
        ]

    def _width(self) -> int:
        return sum(width + 3 for width in self._widths()) + 1

    def _groups(self, width: int) -> list[list[int]]:
        """Columns of each part, the naming ones first."""
        widths, names = self._widths(), list(range(self.left))
        used = sum(widths[i] + 3 for i in names) + 1
        groups, room = [list(names)], width - used
        for i in range(self.left, len(self.columns)):
            if widths[i] + 3 > room and len(groups[-1]) > self.left:
                groups.append(list(names))
                room = width - used
            groups[-1].append(i)
            room -= widths[i] + 3
        return groups

    def _part(self, group: Sequence[int], title: str, caption: str) -> Any:
        table: Any = need("rich.table").Table(
            title=title or None, caption=caption or None, title_justify="left", caption_justify="left"
        )
        for i in group:
            table.add_column(self.columns[i], justify="left" if i < self.left else "right", overflow="fold")
        for row in self.rows:
            table.add_row(*(str(row[i]) for i in group))
        return table


def print_csv(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows as CSV to stdout."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(sys.stdout, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


def show_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "", left: int = 1
) -> None:
    """Print a table to stdout; see `Table`."""
    Table(title, columns, rows, caption, left).show()
