"""How far a study is: one bar for all of it, one for each run at work, frames per second and time left."""

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from arcade_torch.tools.optional import need
from arcade_torch.tools.studies.folder import RunFolder

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


@dataclass
class Snapshot:
    """State of the whole study at one moment."""

    frames: int
    total: int
    ended: int
    runs: int
    speed: float
    active: dict[str, tuple[int, int]]

    @property
    def left_s(self) -> float | None:
        """Seconds left at this speed; None while the speed is unknown."""
        return (self.total - self.frames) / self.speed if self.speed > 0 else None

    def line(self) -> str:
        """One line for a log."""
        left = f", {clock(self.left_s)} left" if self.left_s is not None and self.frames < self.total else ""
        share = 100 * self.frames / self.total if self.total else 0
        pace = f", {self.speed:,.0f} frames/s" if self.speed > 0 else ""
        return f"{self.ended}/{self.runs} runs, {self.frames:,} of {self.total:,} frames ({share:.0f} %){pace}{left}"


class Watcher:
    """Reads the ``progress.json`` of every run."""

    def __init__(self, folders: Mapping[str, RunFolder], guess: int, now: Callable[[], float] = time.monotonic) -> None:
        """Make a watcher.

        Args:
            folders: run name -> folder.
            guess: frames of a run that has not said yet how many it wants; 0 if unknown.
            now: clock in seconds.
        """
        self._folders = dict(folders)
        self._guess = guess
        self._now = now
        self._speed = Speed()
        self.ended: set[str] = set()
        self.failed: set[str] = set()

    def look(self) -> Snapshot:
        """Read all folders once."""
        frames = total = 0
        active: dict[str, tuple[int, int]] = {}
        known = [progress for folder in self._folders.values() if (progress := folder.progress())]
        guess = self._guess or (known[0].total_frames if known else 0)
        for name, folder in self._folders.items():
            progress = folder.progress()
            wanted = progress.total_frames if progress else guess
            done = wanted if name in self.ended else min(progress.frames, wanted) if progress else 0
            frames, total = frames + done, total + wanted
            if progress and progress.status == "running" and name not in self.ended:
                active[name] = (done, wanted)
        ended = len(self.ended)
        return Snapshot(frames, total, ended, len(self._folders), self._speed.update(self._now(), frames), active)


class Display:
    """Shows a watcher: bars on a terminal, a line now and then elsewhere. Use it as a context manager."""

    def __init__(self, watcher: Watcher, title: str, every_s: float = 0.5, stream: Any = None) -> None:
        """Make a display.

        Args:
            watcher: what to show.
            title: name of the whole.
            every_s: seconds between two looks.
            stream: file that is written to, stderr by default.
        """
        self._watcher, self._title, self._every_s = watcher, title, every_s
        self._stream = sys.stderr if stream is None else stream
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, daemon=True, name="study-progress")
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._last_line_s = time.monotonic() - LINE_EVERY_S + 3.0

    def __enter__(self) -> "Display":
        """Start to show."""
        if self._stream.isatty():
            self._bars = _make_bars(self._stream)
            self._tasks[""] = self._bars.add_task(self._title, total=None, speed="")
            self._bars.start()
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Show the last state and stop."""
        self._stop.set()
        self._thread.join()
        self._show()
        if self._bars is not None:
            self._bars.stop()
        else:
            self._print(self._watcher.look().line())

    def note(self, text: str) -> None:
        """Print a line above the bars."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        else:
            self._print(text)

    def _print(self, text: str) -> None:
        print(f"{self._title}: {text}", file=self._stream, flush=True)

    def _loop(self) -> None:
        while not self._stop.wait(self._every_s):
            self._show()

    def _show(self) -> None:
        snapshot = self._watcher.look()
        if self._bars is None:
            if time.monotonic() - self._last_line_s >= LINE_EVERY_S:
                self._last_line_s = time.monotonic()
                self._print(snapshot.line())
            return
        left = f"{clock(snapshot.left_s)} left" if snapshot.left_s is not None else "starting"
        speed = f"{snapshot.ended}/{snapshot.runs} runs  {snapshot.speed:,.0f} frames/s  {left}"
        self._bars.update(self._tasks[""], completed=snapshot.frames, total=snapshot.total or None, speed=speed)
        for name in [name for name in self._tasks if name and name not in snapshot.active]:
            self._bars.remove_task(self._tasks.pop(name))
        for name, (done, wanted) in snapshot.active.items():
            if name not in self._tasks:
                self._tasks[name] = self._bars.add_task(f"  {name.replace('__', ' ')}", total=wanted, speed="")
            self._bars.update(self._tasks[name], completed=done, total=wanted)


def _make_bars(stream: Any) -> Any:
    console = need("rich.console").Console(file=stream)
    progress = need("rich.progress")
    return progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(bar_width=24),
        progress.TaskProgressColumn(),
        progress.TextColumn("{task.fields[speed]}"),
        console=console,
        refresh_per_second=4,
    )
