"""An agent that is complete takes its place: a new folder appears with all of its files."""

import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path

from arcade_torch.agents.runs.bundle import CONFIG, WEIGHTS
from arcade_torch.agents.runs.files import write_atomic

FILMS = ("replay.mp4", "replay.gif")
"""Names of the film of an episode, of which there is one."""


def read_folder(folder: Path) -> dict[str, bytes]:
    """Every file below a folder: its name from there, and what it holds."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def put_files(files: Mapping[str, bytes], folder: Path) -> None:
    """Write the files of an agent into a folder.

    A folder that is not there appears in one step, with all of them. In one that is there each file
    is replaced in one step, weights and settings at last, which know each other by their hash;
    the film of an agent before is removed, and what else lies there is left alone.

    Raises:
        OSError: it cannot be written; ``filename`` is ``folder``, or the file in it.
    """
    if folder.exists():
        _replace(files, folder)
        return
    # beside its place, as only there it can be moved in one step
    draft = folder.with_name(f".{folder.name[:40]}.{os.getpid()}-{secrets.token_hex(4)}.draft")
    try:
        for name, data in files.items():
            write_atomic(draft / name, data)
        os.rename(draft, folder)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _replace(files: Mapping[str, bytes], folder: Path) -> None:
    """Write the files over those of a folder."""
    for name in FILMS:
        if name not in files:
            (folder / name).unlink(missing_ok=True)
    for name in sorted(files, key=(WEIGHTS, CONFIG).__contains__):
        write_atomic(folder / name, files[name])
