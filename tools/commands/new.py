"""``arcade-torch new memory``."""

import keyword
import shlex
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import tyro

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import check_writable, write_atomic
from arcade_torch.tools.options import Command
from arcade_torch.tools.text import say

TEMPLATE = Path(__file__).resolve().parents[1] / "data" / "memory.py.template"


@dataclass
class NewMemory(Command):
    """Write a file with a memory model to change: one page that keeps the laws and learns.

    Example: arcade-torch new memory yours
    """

    # What to call it: lower case letters, digits, underscores.
    name: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[str]]
    out: Path | None = None  # The file; NAME.py in this folder by default. Never overwritten.

    def run(self) -> int:
        """Write the file, and say what comes next."""
        path = self.out or Path(f"{self.name}.py")
        require(path.suffix == ".py", "--out", str(path), "a file that ends in .py")
        text = memory_source(self.name)
        if path.exists() or path.is_symlink():
            raise FileExistsError(f"{path} exists: choose another name, or --out")
        is_shadow = path.stem in sys.stdlib_module_names or find_spec(path.stem) is not None
        if is_shadow:
            raise ValueError(f"{path} would hide the module {path.stem} of Python: choose another")
        write_atomic(check_writable(path), text)
        say(f"written: {path}; change it, and then")
        file_word = shlex.quote(str(path))
        words = f"--import {file_word} --memory {self.name}"
        say(f"  python {file_word}  says whether it keeps the laws of a memory")
        say(f"  arcade-torch compare {words}  how it does against LRU")
        return 0


def memory_source(name: str) -> str:
    """The text of a file that registers a memory model under a name.

    Raises:
        ValueError: a memory cannot have that name, or another one has it.
    """
    from arcade_torch.models.registry import ALIASES, memory_names

    is_name = name.isidentifier() and name == name.lower() and name.isascii()
    require(is_name, "NAME", name, "lower case letters, digits and underscores, no digit first")
    require(not keyword.iskeyword(name), "NAME", name, "no word of Python's grammar")
    if name in (*memory_names(), *ALIASES):
        raise ValueError(f"there is a memory model {name!r} already: choose another name")
    words = [word.capitalize() for word in name.split("_")]
    class_name = "".join(words).removesuffix("Memory") + "Memory"
    source = TEMPLATE.read_text(encoding="utf-8")
    return source.replace("CLASS", class_name).replace("NAME", name)
