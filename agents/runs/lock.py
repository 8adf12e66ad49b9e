"""One process after the other: a lock beside a file that several may change."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock


@contextlib.contextmanager
def locked(file: Path, limit_s: float) -> Iterator[None]:
    """Hold the lock of a file, whose folder is made; ``NAME.lock`` stays beside it.

    Raises:
        OSError: another process holds it for longer than ``limit_s``, or it cannot be made.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(file.with_name(f"{file.name}.lock")).acquire(timeout=limit_s):
        yield
