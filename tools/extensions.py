"""``--import``: a user's own games and memory models on the command line, in workers too."""

import hashlib
import importlib.util
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

FLAG = "--import"
VARIABLE = "ARCADE_TORCH_IMPORT"
"""Environment variable that hands what was imported on to worker processes; entries separated like those of PATH."""


def take_imports(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate ``--import`` from a command line: what to import (files as absolute paths), and the remaining words.

    Example:
        >>> take_imports(["train", "--import", "my_games", "--env", "PairsEasy"])
        (['my_games'], ['train', '--env', 'PairsEasy'])
    """
    found, rest, pending = list[str](), list[str](), iter(words)
    for word in pending:
        flag, equals, value = word.partition("=")
        if flag != FLAG:
            rest.append(word)
            continue
        name = value if equals else next(pending, "")
        if not name or "\0" in name:
            raise ValueError(f"{FLAG} needs a file (games.py) or a module (package.games) that registers something")
        found.append(str(Path(name).resolve()) if _is_file(name) else name)
    return found, rest


def load_extensions(names: Sequence[str] = ()) -> None:
    """Import files and modules that register games or memory models, once a process, and all that a parent process did.

    Raises:
        FileNotFoundError: there is no such file or module.
        ValueError: it could not be imported; says why in one line.
    """
    if wanted := list(dict.fromkeys([*imported(), *names])):
        for name in wanted:
            _load(name)
        os.environ[VARIABLE] = os.pathsep.join(wanted)


def imported() -> list[str]:
    """What is imported in this process and its workers."""
    return [name for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]


def command_line(words: Sequence[str]) -> str:
    """A line for a shell that runs ``arcade-torch`` with these words and the same imports."""
    return shlex.join(["arcade-torch", *words, *(part for name in imported() for part in (FLAG, name))])


def _is_file(name: str) -> bool:
    return name.endswith(".py") or os.sep in name


def _load(name: str) -> None:
    if _is_file(name) and not Path(name).is_file():
        raise FileNotFoundError(f"{FLAG} {name}: there is no such file")
    try:
        if _is_file(name):
            _load_file(Path(name))
        else:
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name and (name == error.name or name.startswith(f"{error.name}.")):
            raise FileNotFoundError(f"{FLAG} {name}: there is no module of that name; a file needs its .py") from error
        raise ValueError(f"{FLAG} {name}: it imports {error.name}, which is not installed") from error
    except Exception as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{FLAG} {name}: it could not be imported, {type(error).__name__}: {reason}") from error


def _load_file(path: Path) -> None:
    """Import a file under a name of its own, so that two files of one name do not meet."""
    name = f"{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError("it is not a Python file")
    sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(sys.modules[name])
    except BaseException:
        del sys.modules[name]
        raise
