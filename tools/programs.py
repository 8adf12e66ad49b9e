"""What JAX has compiled, kept between commands: a game takes ten seconds of a core to compile, and
half a second to read.

The programs lie in a folder of the user's own, one for each kind of processor, because what was
compiled for one may not run on another that shares the same home.
"""

import hashlib
import os
import platform
import stat
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path

DAYS = 30
"""A program is compiled anew after so many days, so that those nobody needs any more go."""
_FOLDER = "JAX_COMPILATION_CACHE_DIR"
_KINDS = ("model name", "flags", "CPU part", "Features")  # lines of /proc/cpuinfo
_SMALL_ONES_TOO = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


def keep_programs() -> None:
    """Let JAX, which must not be imported yet, keep and find again what it compiles in this process
    and in those it starts.

    A folder that the user has named (``JAX_COMPILATION_CACHE_DIR``) stays as it is, also an empty
    name, with which nothing is kept. Nor is anything kept where the user's cache cannot be written
    to, or others can.
    """
    if _FOLDER in os.environ or "jax" in sys.modules:
        return
    with suppress(OSError, RuntimeError):  # of a user without a home
        folder = programs_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_ours_alone(folder):
            _remove_old(folder)
            # of a program that cannot be read or written, JAX says a line at every start; it is
            # compiled, as it would be without the folder
            warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation")
            for name, value in ({_FOLDER: str(folder)} | _SMALL_ONES_TOO).items():
                os.environ.setdefault(name, value)


def programs_folder() -> Path:
    """Where programs for this kind of processor are kept, in ``$XDG_CACHE_HOME`` or
    ``~/.cache``.
    """
    cache = os.environ.get("XDG_CACHE_HOME", "")
    home = Path(cache) if os.path.isabs(cache) else Path.home() / ".cache"
    kind = hashlib.sha256(_processor().encode()).hexdigest()[:16]
    return home / "arcade-torch" / f"programs-{kind}"


def _processor() -> str:
    """What tells processors apart that do not run each other's programs."""
    words = [platform.system(), platform.machine(), platform.processor()]
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        words += sorted({line for line in lines if line.startswith(_KINDS)})
    return "\n".join(words)


def _is_ours_alone(folder: Path) -> bool:
    """Whether nobody else can put a program there: what is read from it is run."""
    status = folder.stat()
    others = stat.S_IWGRP | stat.S_IWOTH
    owner = os.getuid() if hasattr(os, "getuid") else status.st_uid
    return status.st_uid == owner and not status.st_mode & others and os.access(folder, os.W_OK)


def _remove_old(folder: Path) -> None:
    """Remove programs that were compiled `DAYS` ago, and those that a full disk left empty."""
    oldest = time.time() - DAYS * 24 * 3600
    for file in folder.iterdir():
        with suppress(OSError):  # another process was faster
            status = file.stat()
            if status.st_mtime < oldest or status.st_size == 0:
                file.unlink()
