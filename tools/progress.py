"""Progress on stderr: bars on a terminal, a line now and then elsewhere."""

import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from arcade_torch.tools.optional import need

WINDOW_S = 30.0
"""Speed is measured over the last so many seconds."""

LINE_EVERY_S = 15.0
"""Where the output is no terminal, a line is printed this often."""


@dataclass
class Speed:
    """Frames per second over a sliding window."""

    window_s: float = WINDOW_S
    seen: deque[tuple[float, int]] = field(default_factory=deque)

    def update(self, now_s: float, frames: int) -> float:
        """Take a reading and return the speed, 0 until there are two readings.

        Args:
            now_s: a clock that only moves forward.
            frames: total so far.
        """
        self.seen.append((now_s, frames))
        while len(self.seen) > 2 and now_s - self.seen[0][0] > self.window_s:
            self.seen.popleft()
        span = now_s - self.seen[0][0]
        return max(0.0, (frames - self.seen[0][1]) / span) if span > 0 else 0.0


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
    """Shows how much of each named part is done; use it as a context manager.

    Args:
        stream: where to write, stderr by default.
        first_line_s: seconds until the first line.

    Example:
        >>> with Bars() as bars:
        ...     bars.update("run-one", 3, 100)
    """

    def __init__(self, stream: Any = None, first_line_s: float = LINE_EVERY_S) -> None:
        self.stream = sys.stderr if stream is None else stream
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._last_s = time.monotonic() - LINE_EVERY_S + first_line_s

    def __enter__(self) -> "Bars":
        """Start to show."""
        if self.stream.isatty():
            rich = need("rich.progress")
            console = need("rich.console").Console(file=self.stream)
            columns = [rich.TextColumn("{task.description}", markup=False), rich.BarColumn(bar_width=24)]
            columns += [rich.TaskProgressColumn(), rich.TextColumn("{task.fields[text]}", markup=False)]
            self._bars = rich.Progress(*columns, console=console, refresh_per_second=4)
            self._bars.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop."""
        if self._bars is not None:
            self._bars.stop()

    def update(self, name: str, done: int, total: int | None, text: str = "", line: str = "") -> None:
        """Show one step.

        Args:
            name: what is worked on.
            done: how much is done.
            total: of how much; None where nobody knows.
            text: behind the bar.
            line: what to print where there are no bars; ``name: done of total`` by default.
        """
        if self._bars is not None:
            if name not in self._tasks:
                self._tasks[name] = self._bars.add_task(name, total=total, text=text)
            self._bars.update(self._tasks[name], completed=done, total=total, text=text)
            return
        now = time.monotonic()
        if now - self._last_s >= LINE_EVERY_S or (line and total is not None and done >= total):
            self._last_s = now
            print(line or f"{name}: {done} of {total}", file=self.stream, flush=True)

    def note(self, text: str) -> None:
        """Print a line above the bars."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=self.stream, flush=True)

    def remove(self, name: str) -> None:
        """Forget a part."""
        if self._bars is not None and name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))


_SHOWN = {
    "return {:.3f}": "train_return_ewm",
    "of last episodes {:.3f}": "train_return_last",
    "greedy {:.3f}": "eval_return",
    "loss {:.3g}": "loss",
    "epsilon {:.2f}": "epsilon",
    "entropy {:.2f}": "entropy",
    "lr {:.1e}": "lr",
}


class TrainBar:
    """Shows the rows of ``metrics.csv`` as they come; use it as a context manager and give `update` to ``train``.

    Args:
        title: name of the run.
        stream: where to write, stderr by default.
    """

    def __init__(self, title: str, stream: Any = None) -> None:
        self.title, self.speed, self.bars = title, Speed(), Bars(stream, first_line_s=0.0)

    def __enter__(self) -> "TrainBar":
        """Start to show."""
        self.bars.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop."""
        self.bars.__exit__()

    def update(self, row: Mapping[str, Any]) -> None:
        """Show one update.

        Args:
            row: of ``metrics.csv``, with ``total_frames``.
        """
        frames, total, reached = int(row["frames"]), int(row["total_frames"]), standing(row)
        speed = self.speed.update(time.monotonic(), frames)
        pace = f", {speed:,.0f} frames/s" if speed > 0 else ""
        left = f", {clock((total - frames) / speed)} left" if speed > 0 and frames < total else ""
        line = f"{frames:,} of {total:,} frames{pace}{left}; {reached}"
        self.bars.update(self.title, frames, total, f"{pace}{left}  {reached}".lstrip(", "), line)


def standing(row: Mapping[str, Any]) -> str:
    """How a run stands, in a few words: returns, loss, exploration, step size; what there is not yet is left out.

    Args:
        row: of ``metrics.csv``, with ``eval_return``.

    Example:
        >>> standing({"train_return_ewm": 0.5, "eval_return": None, "loss": 0.0123, "epsilon": 0.2, "lr": 5e-5})
        'return 0.500, loss 0.0123, epsilon 0.20, lr 5.0e-05'
    """
    found = {words: row.get(key) for words, key in _SHOWN.items()}
    return ", ".join(words.format(float(value)) for words, value in found.items() if value is not None)
