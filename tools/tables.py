"""Tables on the terminal."""

import sys
from collections.abc import Sequence
from typing import Any

from arcade_torch.tools.optional import need


def show_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "", left: int = 1
) -> None:
    """Print a table to stdout.

    Args:
        title: above it.
        columns: headers.
        rows: cells; written with ``str``.
        caption: below it.
        left: how many columns are aligned left; the others are numbers.
    """
    table: Any = need("rich.table").Table(
        title=title, caption=caption or None, title_justify="left", caption_justify="left"
    )
    for index, name in enumerate(columns):
        table.add_column(name, justify="left" if index < left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(str(cell) for cell in row))
    options = {} if sys.stdout.isatty() else {"width": 200}
    need("rich.console").Console(highlight=False, markup=False, **options).print(table)
