"""Progress on stderr: bars on a terminal, a line now and then elsewhere."""

import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from arcade_torch.tools.optional import need

WINDOW_S = 30.0
"""Speed is measured over the last so many seconds."""
LINE_EVERY_S = 15.0
"""Where the output is no terminal, a line is printed this often."""


@dataclass
class Speed:
    """How fast frames come, over a sliding window."""

    window_s: float = WINDOW_S
    seen: deque[tuple[float, int]] = field(default_factory=deque)

    def update(self, now_s: float, frames: int) -> float:
        """Take a reading of a clock and of all frames so far; return the speed, 0 until there are two readings."""
        self.seen.append((now_s, frames))
        while len(self.seen) > 2 and now_s - self.seen[0][0] > self.window_s:
            self.seen.popleft()
        span = now_s - self.seen[0][0]
        return max(0.0, (frames - self.seen[0][1]) / span) if span > 0 else 0.0

    def words(self, frames: int, total: int) -> str:
        """Speed and time left, after a comma; nothing as long as there is no speed."""
        speed = self.update(time.monotonic(), frames)
        left = f", {clock((total - frames) / speed)} left" if speed > 0 and frames < total else ""
        return f", {speed:,.0f} frames/s{left}" if speed > 0 else ""


def clock(seconds: float) -> str:
    """Seconds as ``m:ss`` or ``h:mm:ss``.

    Example:
        >>> clock(75), clock(3675)
        ('1:15', '1:01:15')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Bars:
    """Shows on stderr, or another stream, how much of each named part is done; use it as a context manager.

    Example:
        >>> with Bars() as bars:
        ...     bars.update("run-one", 3, 100)
    """

    def __init__(self, stream: Any = None, first_line_s: float = LINE_EVERY_S) -> None:
        self.stream = sys.stderr if stream is None else stream
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._last_s = time.monotonic() - LINE_EVERY_S + first_line_s

    def __enter__(self) -> Self:
        """Start to show."""
        if self.stream.isatty():
            rich = need("rich.progress")
            columns = [rich.TextColumn("{task.description}", markup=False), rich.BarColumn(bar_width=24)]
            columns += [rich.TaskProgressColumn(), rich.TextColumn("{task.fields[text]}", markup=False)]
            console = need("rich.console").Console(file=self.stream)
            self._bars = rich.Progress(*columns, console=console, refresh_per_second=4)
            self._bars.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop."""
        if self._bars is not None:
            self._bars.stop()

    def update(self, name: str, done: int, total: int | None, text: str = "", line: str = "") -> None:
        """Show how much of a part is done; ``text`` stands behind its bar, ``line`` is for where there are no bars."""
        now = time.monotonic()
        if self._bars is not None:
            if name not in self._tasks:
                self._tasks[name] = self._bars.add_task(name, total=total, text=text)
            self._bars.update(self._tasks[name], completed=done, total=total, text=text)
        elif now - self._last_s >= LINE_EVERY_S or (line and total is not None and done >= total):
            self._last_s = now
            self.note(line or f"{name}: {done} of {total}")

    def note(self, text: str) -> None:
        """Print a line, above the bars if there are any."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=self.stream, flush=True)

    def remove(self, name: str) -> None:
        """Forget a part."""
        if name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))


class TrainBar(Bars):
    """Shows the rows of ``metrics.csv`` as they come; use it as a context manager and give `show` to ``train``."""

    def __init__(self, title: str, stream: Any = None) -> None:
        super().__init__(stream, first_line_s=0.0)
        self.title, self.speed = title, Speed()

    def show(self, row: Mapping[str, Any]) -> None:
        """Show one update: a row of ``metrics.csv`` with ``total_frames``."""
        frames, total, reached = int(row["frames"]), int(row["total_frames"]), standing(row)
        pace = self.speed.words(frames, total)
        line = f"{frames:,} of {total:,} frames{pace}; {reached}"
        self.update(self.title, frames, total, f"{pace}  {reached}".lstrip(", "), line)


_SHOWN = {
    "train_return_ewm": "return {:.3f}",
    "train_return_last": "of last episodes {:.3f}",
    "eval_return": "greedy {:.3f}",
    "loss": "loss {:.3g}",
    "epsilon": "epsilon {:.2f}",
    "entropy": "entropy {:.2f}",
    "lr": "lr {:.1e}",
}


def standing(row: Mapping[str, Any]) -> str:
    """How a run stands by a row of ``metrics.csv``, in a few words; what there is not yet is left out.

    Example:
        >>> standing({"train_return_ewm": 0.5, "eval_return": None, "loss": 0.0123, "epsilon": 0.2, "lr": 5e-5})
        'return 0.500, loss 0.0123, epsilon 0.20, lr 5.0e-05'
    """
    return ", ".join(words.format(float(row[key])) for key, words in _SHOWN.items() if row.get(key) is not None)
