"""Where runs lie on the disk: the folders with a ``config.json`` below a folder, through symbolic
links too.
"""

import os
from collections.abc import Iterator
from pathlib import Path

MOST_DEPTH = 16
"""Folders are looked into so far below the one that is named."""
SETTINGS = "config.json"
_OF_A_RUN = ("checkpoints", "replay")
"""Folders of a run that hold no runs."""


class RunFolders:
    """Finds run folders, each real folder once, however many links lead to it.

    Links are followed after everything else, so that a run has the name of its own folder where
    that lies below the same root. A link to a folder that holds the root is left alone: what lies
    there was not asked for.
    """

    def __init__(self) -> None:
        self.notes: list[str] = []
        """What could not be looked into, for the user."""
        self._seen: set[str] = set()

    def has_seen(self, folder: Path) -> bool:
        """Whether a folder was looked into already."""
        return os.path.realpath(folder) in self._seen

    def below(self, root: Path) -> Iterator[Path]:
        """Every run folder at or below ``root`` that was not met before, in no order."""
        real_root = os.path.realpath(root)
        waiting = [(root, real_root, 0)]
        links = list[tuple[Path, str, int]]()
        while waiting or links:
            folder, real, depth = waiting.pop() if waiting else links.pop(0)
            if real in self._seen or depth > MOST_DEPTH:
                continue
            self._seen.add(real)
            is_run = os.path.exists(folder / SETTINGS)
            if is_run:
                yield folder
            for entry in self._folders_in(folder):
                if is_run and entry.name in _OF_A_RUN:
                    continue
                if not entry.is_symlink():
                    waiting.append((folder / entry.name, os.path.join(real, entry.name), depth + 1))
                    continue
                target = os.path.realpath(entry.path)
                if not _holds(target, real_root):
                    links.append((folder / entry.name, target, depth + 1))

    def _folders_in(self, folder: Path) -> list[os.DirEntry[str]]:
        """Folders, and links to folders, in a folder; a note where it may not be read, and on links
        to nothing.
        """
        try:
            with os.scandir(folder) as entries:
                listed = sorted(entries, key=lambda entry: entry.name)
        except OSError as error:
            self.notes.append(f"left out, {error.strerror or error}: {folder}")
            return []
        for entry in listed:
            if entry.is_symlink() and not os.path.exists(entry.path):
                self.notes.append(f"left out, a link that leads nowhere: {entry.path}")
        return [entry for entry in listed if _is_folder(entry)]


def _is_folder(entry: "os.DirEntry[str]") -> bool:
    """Whether an entry is a folder or a link to one; what may not be looked at is none."""
    try:
        return entry.is_dir()
    except OSError:
        return False


def _holds(folder: str, other: str) -> bool:
    """Whether ``other`` is ``folder``, or lies below it; both are real paths."""
    return os.path.join(other, "").startswith(os.path.join(folder, ""))
