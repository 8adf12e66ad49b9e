"""``--import`` of a user's games and models, and what runs remember of it.

A run folder keeps the absolute path and the SHA-256 of the files that its game or memory model came
from. That says what to import, and never that it may be: a folder can come from somebody else and
name any file of this machine. So every file behind ``--import`` is also noted in a record of the
user, outside of all run folders, and what a run remembers is imported again only where that record
holds the same path with the same hash.
"""

import contextlib
import hashlib
import importlib.util
import json
import os
import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arcade_torch.agents.runs.files import read_bytes, read_json, write_json
from arcade_torch.agents.runs.shipped import agent_folder, agents_hint, no_folder
from arcade_torch.tools.errors import one_line
from arcade_torch.tools.text import warn

if TYPE_CHECKING:
    from arcade_torch.agents.config import TrainConfig
    from arcade_torch.agents.policy import Agent

FLAG = "--import"
VARIABLE = "ARCADE_TORCH_IMPORT"
"""Environment variable that hands what was imported on to worker processes, an entry a line."""
HASHES_VARIABLE = "ARCADE_TORCH_IMPORT_SHA256"
"""The same for the SHA-256 of the files, in JSON: a worker imports what its study began with."""
MOST_SOURCE = 16 * 2**20
"""Bytes of the largest file that is imported."""
MOST_BESIDE = 400
"""Modules beside one file that are remembered with it."""
MOST_REMEMBERED = 2_000
"""Imports of one run."""
MOST_TRUSTED = 1_000
"""Entries in the user's record; the oldest are forgotten."""
LOCK_LIMIT_S = 10.0
"""So long another process may write that record; after that, nothing is noted."""
Import = dict[str, str]
"""``name``, of a file its absolute path, and ``sha256``, which is empty for a module; of a module
that lies beside a file and was imported by it also ``by``, that file."""

_HASH = re.compile("[0-9a-f]{64}")
_hashes: dict[str, str] = {}  # file that was imported in this process -> SHA-256 of its text
_beside: dict[str, list[Import]] = {}  # such a file -> the modules beside it that it imported
_before: dict[str, set[str]] = {}  # such a file -> the modules that there were before it
_again: set[str] = set()  # what was imported in this process because a run remembers it


class ImportRefusedError(RuntimeError):
    """What a run remembers may not be imported again, or is not there as it was."""


def _of_parent() -> dict[str, str]:
    """File -> SHA-256 of its text in the process that this one works for."""
    with contextlib.suppress(ValueError):
        hashes = json.loads(os.environ.get(HASHES_VARIABLE, ""))
        if isinstance(hashes, dict):
            return hashes
    return {}


_parents = _of_parent()


def take_imports(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate ``--import`` from a command line: what to import (files as absolute paths), and the
    remaining words.

    Example:
        >>> take_imports(["train", "--import", "my_games", "--env", "PairsEasy"])
        (['my_games'], ['train', '--env', 'PairsEasy'])
    """
    modules = list[str]()
    rest = list[str]()
    pending = iter(words)
    for word in pending:
        flag, equals, value = word.partition("=")
        if flag != FLAG:
            rest.append(word)
            continue
        name = value if equals else next(pending, "")
        if not name or "\0" in name or "\n" in name:
            raise ValueError(
                f"{FLAG} needs a file (games.py) or a module (package.games) that registers "
                "something"
            )
        modules.append(str(Path(name).resolve()) if _is_file(name) else name)
    return modules, rest


def import_for_command(names: Sequence[str]) -> None:
    """Import what stands behind ``--import``, and note its files in the user's record; raises as
    `load_extensions`.
    """
    load_extensions(names)
    chosen = [[name, _hashes[name]] for name in names if name in _hashes]
    if not chosen:
        return
    try:
        _note(chosen)
    except (OSError, RuntimeError) as error:  # no home, or a disk that takes no files
        warn(f"later commands need {FLAG} again: no record of it is kept ({one_line(error)})")


def _note(chosen: Sequence[list[str]]) -> None:
    """Add files with their hashes to the user's record, one process after the other."""
    from arcade_torch.agents.runs.lock import locked

    file = record_file()
    with locked(file, LOCK_LIMIT_S):
        entries = [entry for entry in _trusted() if entry not in chosen]
        write_json(file, [*entries, *chosen][-MOST_TRUSTED:])


def load_extensions(names: Sequence[str] = ()) -> None:
    """Import files and modules that register games or memory models, once a process, and all that a
    parent process did.

    Raises:
        FileNotFoundError: there is no such file or module.
        ValueError: it could not be imported; says why in one line.
    """
    if wanted := list(dict.fromkeys([*imported(), *names])):
        for name in wanted:
            _load(name, expected="" if name in names else _parents.get(name, ""))
        _hand_on(wanted)


def _hand_on(names: Iterable[str]) -> None:
    """Tell worker processes what to import."""
    os.environ[VARIABLE] = "\n".join(names)
    hashes = dict(_hashes)
    for entries in _beside.values():
        hashes |= {entry["name"]: entry["sha256"] for entry in entries}
    os.environ[HASHES_VARIABLE] = json.dumps(hashes)


def for_workers() -> dict[str, str]:
    """The environment variables that tell worker processes on other machines what to import."""
    return {name: os.environ.get(name, "") for name in (VARIABLE, HASHES_VARIABLE)}


def imported() -> list[str]:
    """What is imported in this process and its workers."""
    return [name for name in os.environ.get(VARIABLE, "").split("\n") if name]


def imports_of(config: "TrainConfig") -> list[Import]:
    """What a run has to remember: all that is imported, or nothing if its game and its memory are
    of this package.
    """
    from arcade_torch.envs_jax.registry import is_built_in as is_our_game

    if is_our_game(config.env) and not is_from_user(config.memory):
        return []
    entries = list[Import]()
    for name in imported():
        entries.append({"name": name, "sha256": _hashes.get(name, "")})
        _beside[name] = _beside_until_now(name)
        entries += _beside[name]
    return entries


def _beside_until_now(name: str) -> list[Import]:
    """What stands beside a file and was imported by it, or later, by what it registers."""
    entries = {entry["name"]: entry for entry in _beside.get(name, [])}
    later = set(sys.modules) - _before.get(name, set(sys.modules))
    for entry in _modules_beside(name, later):
        if entry["name"] not in _hashes:
            entries.setdefault(entry["name"], entry)
    return list(entries.values())[:MOST_BESIDE]


def is_as_it_was(name: str, sha256: str) -> bool:
    """Whether a module that is imported late has the text that a run remembers; nothing is opened
    but what lies beside a file that was imported in this process.
    """
    if not any(name.startswith(os.path.join(os.path.dirname(file), "")) for file in _hashes):
        return False
    with contextlib.suppress(OSError, ValueError):  # gone since, or no regular file
        return hashlib.sha256(read_bytes(Path(name), MOST_SOURCE)).hexdigest() == sha256
    return False


def is_from_user(memory: str) -> bool:
    """Whether a memory model is none of this package."""
    from arcade_torch.models.presets import FEED_FORWARD
    from arcade_torch.models.registry import is_built_in

    return memory != FEED_FORWARD and not is_built_in(memory)


def import_again(path: Path) -> None:
    """Import what the run at a path remembers, if the user has imported it on this machine before.

    An ``--import`` that was given to this process takes the place of what runs remember.

    Args:
        path: a run folder, its ``checkpoints`` folder, or one of its checkpoints; where there is no
            ``config.json`` nothing happens.

    Raises:
        ImportRefusedError: the user has not imported that file here, it has changed since, or it is
            gone; says how to go on.
        ValueError: the ``config.json`` is damaged, or the file cannot be imported.
    """
    if set(imported()) - _again:
        return
    absolute = path.absolute()
    for folder in (absolute, *absolute.parents[:2]):
        file = folder / "config.json"
        if file.is_file():
            entries = _remembered(read_json(file), file)
            for entry in entries:
                if "by" not in entry:
                    _import_again(path, entry["name"], entry["sha256"])
            _check_beside(path, [entry for entry in entries if "by" in entry])
            return


def load_agent(path: Path) -> "Agent":
    """The agent of a run, a checkpoint or one of this package by its name, after `import_again`;
    raises as `agents.load` too.
    """
    from arcade_torch.agents.policy import agent_of
    from arcade_torch.agents.pretrained import read_shared

    folder = agent_folder(path)
    import_again(folder)
    return agent_of(read_shared(folder))


def existing_agent(path: Path) -> Path:
    """The folder of an agent that a user names; a ``FileNotFoundError`` if there is none, before
    anything heavy is imported.
    """
    folder = agent_folder(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"{no_folder(folder)}; {agents_hint(folder)}")
    return folder


def remembered_imports(record: Any, file: Path) -> dict[str, str]:
    """The imports in what a ``config.json`` holds, name -> SHA-256, with the modules beside files;
    a ``ValueError`` if they are damaged.
    """
    return {entry["name"]: entry["sha256"] for entry in _remembered(record, file)}


def _remembered(record: Any, file: Path) -> list[Import]:
    """The same as they stand there."""
    imports = record.get("imports", []) if isinstance(record, Mapping) else []
    if not isinstance(imports, list) or len(imports) > MOST_REMEMBERED:
        raise ValueError(f"{file} is damaged: its imports are no list of at most {MOST_REMEMBERED}")
    for entry in imports:
        if not isinstance(entry, dict) or not _is_import(entry.get("name"), entry.get("sha256")):
            raise ValueError(f"{file} is damaged: an import has a name and a sha256")
    return imports


def _is_import(name: object, sha256: object) -> bool:
    """Whether these are the name of a module, or the path of a file and its hash."""
    if not isinstance(name, str) or not isinstance(sha256, str) or not name or "\0" in name:
        return False
    return not sha256 or (_HASH.fullmatch(sha256) is not None and os.path.isabs(name))


def _import_again(run: Path, name: str, sha256: str) -> None:
    """Import one file; one that the user has not imported before is not even opened."""
    option = f"{FLAG} {shlex.quote(name)}"
    if not sha256:
        raise ImportRefusedError(
            f"{run} imported the module {name}, and modules are never imported again by "
            f"themselves: pass {option}"
        )
    if [name, sha256] not in _trusted():
        raise ImportRefusedError(
            f"{run} imported {name}, which you have not imported on this machine: pass {option} if "
            "you trust it"
        )
    changed = ImportRefusedError(
        f"{run} imported {name}, which has changed since: pass {option} to take it as it is now"
    )
    if _hashes.get(name, sha256) != sha256:
        raise changed
    try:
        text = read_bytes(Path(name), MOST_SOURCE)
    except FileNotFoundError:
        raise ImportRefusedError(
            f"{run} imported {name}, which is not there any more: pass {FLAG} with its new place"
        ) from None
    if hashlib.sha256(text).hexdigest() != sha256:
        raise changed
    _load(name, text)
    _again.add(name)
    _hand_on(dict.fromkeys([*imported(), name]))


def _check_beside(run: Path, entries: Sequence[Import]) -> None:
    """Refuse a run whose file imported a module beside it that is another now."""
    if not entries:
        return
    now = set[str]()
    for file in list(_hashes):
        now |= {entry["sha256"] for entry in _modules_beside(file, sys.modules)}
    for entry in entries:
        if entry["sha256"] not in now and not is_as_it_was(entry["name"], entry["sha256"]):
            raise ImportRefusedError(
                f"{run} imported {entry['name']} by way of {entry['by']}, and it has changed "
                f"since: put it back, or pass {FLAG} {shlex.quote(str(entry['by']))} to take it as "
                "it is now"
            )


def record_file() -> Path:
    """The user's record of the files that were imported on this machine."""
    state = os.environ.get("XDG_STATE_HOME", "")
    folder = Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state"
    return folder / "arcade-torch" / "imports.json"


def _trusted() -> list[Any]:
    """Path and hash of the files in the user's record; none if it is damaged."""
    try:
        entries = read_json(record_file())
    except (OSError, ValueError, RuntimeError):
        return []
    return entries if isinstance(entries, list) else []


def _is_file(name: str) -> bool:
    return name.endswith(".py") or os.sep in name


class _Source(SourceFileLoader):
    """Runs the very text that was hashed: compiled files beside it are neither read nor written."""

    def __init__(self, module: str, path: str, text: bytes) -> None:
        super().__init__(module, path)
        self._text = text

    def get_data(self, path: str) -> bytes:
        """The text, whatever the path."""
        return self._text

    def path_stats(self, path: str) -> Mapping[str, Any]:
        """Say that nothing is known of the file, so that no compiled one is taken for it."""
        raise OSError("only the text counts")


def _load(name: str, text: bytes | None = None, expected: str = "") -> None:
    """Import a module, or a file: its text may have been read already, or has to have an expected
    SHA-256.
    """
    if _is_file(name) and not Path(name).is_file():
        raise FileNotFoundError(f"{FLAG} {name}: there is no such file")
    try:
        if _is_file(name):
            _run_file(name, text, expected)
        else:
            importlib.import_module(name)
    except ImportRefusedError:
        raise
    except SystemExit as error:
        raise ValueError(
            f"{FLAG} {name}: it ended the program while it was imported (SystemExit: {error}); "
            "what it does as a program belongs below if __name__ == '__main__':"
        ) from error
    except Exception as error:
        if not isinstance(error, ModuleNotFoundError):
            why = f"it could not be imported, {type(error).__name__}: {one_line(error)}"
        elif error.name and (name == error.name or name.startswith(f"{error.name}.")):
            raise FileNotFoundError(
                f"{FLAG} {name}: there is no module of that name; a file needs its .py"
            ) from error
        else:
            why = f"it imports {error.name}, which is neither installed nor beside it"
        raise ValueError(f"{FLAG} {name}: {why}") from error


def _run_file(name: str, text: bytes | None, expected: str) -> None:
    """Import a file under a name of its own, so that two files of one name do not meet.

    It finds what stands beside it, as a file that Python runs does, but behind all that is
    installed.
    """
    module = f"{Path(name).stem}_{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    if module in sys.modules:
        return
    if text is None:
        text = read_bytes(Path(name), MOST_SOURCE)
    sha256 = hashlib.sha256(text).hexdigest()
    if expected and expected != sha256:
        raise _changed(name)
    before = set(sys.modules)
    loader = _Source(module, name, text)
    spec: Any = importlib.util.spec_from_file_location(module, name, loader=loader)
    folder = str(Path(name).parent)
    if folder not in sys.path:
        sys.path.append(folder)
    sys.modules[module] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(sys.modules[module])
    except BaseException:
        del sys.modules[module]
        raise
    beside = _modules_beside(name, set(sys.modules) - before)
    for entry in beside:
        if expected and _parents.get(entry["name"], entry["sha256"]) != entry["sha256"]:
            del sys.modules[module]
            raise _changed(entry["name"])
    _hashes[name] = sha256
    _before[name] = before
    _beside[name] = beside


def _modules_beside(name: str, modules: Iterable[str]) -> list[Import]:
    """Those of some modules that lie in the folder of a file, or below it, and are not installed
    there.
    """
    folder = os.path.join(os.path.dirname(name), "")
    entries = dict[str, Import]()
    for module in sorted(modules):
        file = os.path.realpath(getattr(sys.modules.get(module), "__file__", None) or "")
        is_ours = module.partition(".")[0] in ("__main__", "arcade_torch")
        is_installed = "site-packages" in file or "dist-packages" in file
        is_beside = file.startswith(folder) and file.endswith(".py") and file != name
        if is_beside and not is_ours and not is_installed:
            with contextlib.suppress(OSError, ValueError):  # gone since, or no regular file
                sha256 = hashlib.sha256(read_bytes(Path(file), MOST_SOURCE)).hexdigest()
                entries[file] = {"name": file, "sha256": sha256, "by": name}
    return list(entries.values())[:MOST_BESIDE]


def _changed(name: str) -> ImportRefusedError:
    return ImportRefusedError(
        f"{FLAG} {name}: it has changed since this work began: put it back as it was, or start anew"
    )
