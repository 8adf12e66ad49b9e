"""Progress of an analysis over checkpoints: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from typing import Any

from arcade_torch.tools.optional import need
from arcade_torch.tools.studies.progress import LINE_EVERY_S


class CountBar:
    """Shows how many of how many things are done for each named part; use it as a context manager.

    Example:
        >>> with CountBar() as bar:
        ...     bar.update("run-one", 3, 100)
    """

    def __init__(self, stream: Any = None) -> None:
        """Make a bar.

        Args:
            stream: where to write, stderr by default.
        """
        self._stream = sys.stderr if stream is None else stream
        self._bar: Any = None
        self._name, self._last_s = "", time.monotonic()

    def __enter__(self) -> "CountBar":
        """Start to show."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop."""
        if self._bar is not None:
            self._bar.close()

    def update(self, name: str, done: int, total: int) -> None:
        """Show one step.

        Args:
            name: what is worked on.
            done: how many are done.
            total: of how many.
        """
        if self._stream.isatty():
            if name != self._name:
                self.__exit__()
                self._bar = need("tqdm").tqdm(desc=name, total=total, file=self._stream)
            self._name = name
            self._bar.update(done - self._bar.n)
            return
        now = time.monotonic()
        if now - self._last_s >= LINE_EVERY_S:
            self._last_s = now
            print(f"{name}: {done} of {total}", file=self._stream, flush=True)
