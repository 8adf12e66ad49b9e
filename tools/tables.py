"""Tables: on the terminal, in Markdown."""

import os
import sys
from collections.abc import Sequence
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
        lines = [list(map(str, line)) for line in (self.columns, *self.rows)]
        widths = [
            max(len(part) for cell in cells for part in cell.split("\n")) + 3 for cells in zip(*lines, strict=True)
        ]
        console = need("rich.console").Console
        terminal = sys.stdout.isatty() or "COLUMNS" in os.environ
        width = max(console().width if terminal else sum(widths) + 1, NARROWEST)
        names = list(range(self.left))
        parts = [names]
        for i in range(self.left, len(self.columns)):
            if len(parts[-1]) > self.left and sum(widths[j] for j in (*parts[-1], i)) + 1 > width:
                parts.append(names)
            parts[-1] = [*parts[-1], i]
        for part in parts:
            title, caption = self.title if part is parts[0] else "", self.caption if part is parts[-1] else ""
            table = need("rich.table").Table(title=title or None, caption=caption or None)
            table.title_justify = table.caption_justify = "left"
            for i in part:
                table.add_column(lines[0][i], justify="left" if i < self.left else "right", overflow="fold")
            for line in lines[1:]:
                table.add_row(*(line[i] for i in part))
            console(highlight=False, markup=False, width=width).print(table)


def format_value(value: Any) -> str:
    """A cell: numbers with four digits or in whole thousands."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value)


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]], left: int | None = None) -> str:
    """A Markdown table; columns after the first ``left`` are aligned right."""
    left = len(columns) if left is None else left
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in (columns, *rows)]
    return "\n".join([lines[0], "|---" * left + "|---:" * (len(columns) - left) + "|", *lines[1:]])
