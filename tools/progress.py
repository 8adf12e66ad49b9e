"""Progress on stderr: bars on a terminal, a line now and then elsewhere. Speed and time left are
measured by rich.
"""

import sys
import time
from collections.abc import Mapping
from datetime import timedelta
from typing import Any, Self

from arcade_torch.tools.errors import need
from arcade_torch.tools.text import printable

WINDOW_S = 30.0
"""Speed is measured over the last so many seconds."""
LINE_EVERY_S = 15.0
"""Where the output is no terminal, a line is printed this often."""


class Bars:
    """Shows on stderr, or another stream, how much of each named part is done; use it as a context
    manager.

    Args:
        stream: where to; stderr by default.
        unit: what is counted, such as frames; if it is named, speed and time left are shown, and
            without a terminal the last line says how far the work came.
        first_line_s: when the first line is printed, where there is no terminal.

    Example:
        >>> with Bars() as bars:
        ...     bars.update("run-one", 3, 100)
    """

    def __init__(
        self, stream: Any = None, unit: str = "", first_line_s: float = LINE_EVERY_S
    ) -> None:
        self.stream = sys.stderr if stream is None else stream
        self.unit = unit
        self.terminal = self.stream.isatty()
        rich = need("rich.progress")
        console = need("rich.console").Console(file=self.stream)
        column = need("rich.table").Column
        # only the words go on in further lines where a terminal is narrow: they stand last
        columns = [
            rich.BarColumn(bar_width=16, table_column=column(no_wrap=True)),
            rich.TaskProgressColumn(table_column=column(no_wrap=True)),
            rich.TextColumn(
                "{task.description}{task.fields[text]}",
                markup=False,
                table_column=column(overflow="fold"),
            ),
        ]
        self._bars = rich.Progress(
            *columns, console=console, refresh_per_second=4, speed_estimate_period=WINDOW_S
        )
        self._tasks: dict[str, Any] = {}
        self._next_line_s = time.monotonic() + first_line_s
        self._line = ""

    def __enter__(self) -> Self:
        """Start to show."""
        if self.terminal:
            self._bars.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop."""
        if self.terminal:
            self._bars.stop()
        elif self.unit and self._line:
            self.note(self._line)

    def update(self, name: str, done: int, total: int, text: str = "") -> None:
        """Show how much of a part is done, of 0 where that is not known, and some words about
        it.
        """
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(printable(name), total=None, text="")
        self._bars.update(self._tasks[name], completed=done, total=total or None)
        task = next(task for task in self._bars.tasks if task.id == self._tasks[name])
        words = []
        if self.unit and task.speed:
            words.append(f"{task.speed:,.0f} {self.unit}/s")
            if task.time_remaining:
                words.append(f"{timedelta(seconds=task.time_remaining)} left")
        if text:
            words.append(text)
        said = printable(", ".join(words))
        task.fields["text"] = f": {said}" if said else ""
        self._line = f"{name}: {done:,}" if total or self.unit or not said else f"{name}: {said}"
        if total:
            self._line += f" of {total:,}"
        if self.unit:
            self._line += f" {self.unit}"
        if total:
            self._line += f" ({task.percentage:.0f} %)"
        if said and (total or self.unit):
            self._line += f", {said}"
        if not self.terminal and time.monotonic() >= self._next_line_s:
            self.note(self._line)
            self._next_line_s = time.monotonic() + LINE_EVERY_S
            self._line = ""

    def note(self, text: str) -> None:
        """Print a line, above the bars if there are any."""
        self._bars.console.print(
            printable(text), markup=False, emoji=False, highlight=False, soft_wrap=True
        )

    def remove(self, name: str) -> None:
        """Forget a part."""
        if name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))


_FORMATS = {
    "train_return_ewm": "return {:.3f}",
    "train_return_last": "of last episodes {:.3f}",
    "eval_return": "greedy {:.3f}",
    "loss": "loss {:.3g}",
    "epsilon": "epsilon {:.2f}",
    "entropy": "entropy {:.2f}",
    "lr": "lr {:.1e}",
}


def describe_row(row: Mapping[str, Any]) -> str:
    """Describe a run by a row of ``metrics.csv``, in a few words; values that are missing are left
    out.

    Example:
        >>> row = {"train_return_ewm": 0.5, "eval_return": None, "loss": 0.0123, "lr": 5e-5}
        >>> describe_row({**row, "epsilon": 0.2})
        'return 0.500, loss 0.0123, epsilon 0.20, lr 5.0e-05'
    """
    parts = []
    for column, words in _FORMATS.items():
        if row.get(column) is not None:
            parts.append(words.format(float(row[column])))
    return ", ".join(parts)
