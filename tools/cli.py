"""The command line ``arcade-torch``.

The first words choose a command, only then is its module imported: help and typing errors stay quick.
Each command is a dataclass in `arcade_torch.tools.commands`: its fields are the options, its docstring is the help, and
its `run` does the work.
"""

import difflib
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NamedTuple

from arcade_torch.tools.bench.registry import BENCHES
from arcade_torch.tools.errors import WORK_FAILED, is_told, one_line
from arcade_torch.tools.extensions import load_extensions, take_imports
from arcade_torch.tools.figures import FIGURES
from arcade_torch.tools.optional import missing_package_message
from arcade_torch.tools.options import parse

EXIT_OK, EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130

HELP = ("-h", "--help", "help")
EVERYWHERE = """\
With any command: --import FILE.py (or MODULE) first imports what registers your own games or memory models;
--debug shows the traceback of an error."""


class Command(NamedTuple):
    """Where a command lives and what it does in a few words."""

    module: str
    summary: str


COMMANDS: dict[str, Command] = {
    "demo": Command("study", "small study of one game: learning, gap, bias and saliency in one HTML page"),
    "list": Command("list", "games, memory models, what scripted players earn, and pictures of the games"),
    "train": Command("train", "train one agent into a run folder"),
    "evaluate": Command("evaluate", "greedy returns of a trained agent"),
    "study": Command("study", "run a grid of trainings from one TOML file, resumable run by run"),
    "report": Command("study", "write the HTML page of a study"),
    **{f"analyze {name}": Command("figure", entry.summary) for name, entry in FIGURES.items() if entry.analysis},
    **{f"figure {name}": Command("figure", entry.summary) for name, entry in FIGURES.items()},
    "play": Command("play", "play a game by hand, in a window or in the terminal"),
    "record": Command("play", "a GIF or MP4 of a random, scripted or trained player"),
    **{f"bench {name}": Command("bench", summary) for name, summary in BENCHES.items()},
    "bench all": Command("bench", "every benchmark into one file, and a page of its tables"),
    "bench compare": Command("bench", "what became better or worse between two such files"),
}


def usage() -> str:
    """The page that ``arcade-torch --help`` prints."""
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items())
    return f"""usage: arcade-torch COMMAND [options]

POPGym Arcade for PyTorch: pixel games as MDP/POMDP twins, and what memory does in them.

{commands}

arcade-torch COMMAND --help explains a command and gives an example.
{EVERYWHERE}
--version prints the version."""


def split_command(words: Sequence[str]) -> tuple[str, list[str]]:
    """Separate the name of the command from its options; a ``ValueError`` names the nearest if there is none.

    Example:
        >>> split_command(["analyze", "gap-bias", "runs/demo"])
        ('analyze gap-bias', ['runs/demo'])
    """
    for length in (2, 1):
        name = " ".join(words[:length])
        if len(words) >= length and name in COMMANDS:
            return name, list(words[length:])
    group, *more = words
    if members := [name.split()[1] for name in COMMANDS if name.startswith(f"{group} ")]:
        if near := difflib.get_close_matches(more[0], members, n=1, cutoff=0.5) if more else []:
            raise ValueError(f"unknown {group} {more[0]!r}: did you mean {near[0]!r}? There are {', '.join(members)}")
        got = f"not {more[0]!r}" if more and not more[0].startswith("-") else "and which one is missing"
        raise ValueError(f"arcade-torch {group} is followed by {' or '.join(members)}, {got}")
    names = dict.fromkeys([*COMMANDS, *(name.split()[0] for name in COMMANDS)])
    near = difflib.get_close_matches(group, names, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"unknown command {group!r}: {hint}commands are {', '.join(COMMANDS)}")


def _say(text: str) -> None:
    print(f"arcade-torch: {text}", file=sys.stderr)


def _terminate(signum: int, frame: object) -> None:
    raise KeyboardInterrupt


def command_class(name: str) -> Any:
    """The dataclass of a command; where options decide more than tyro reads, `read_command` asks its module."""
    module = import_module(f"arcade_torch.tools.commands.{COMMANDS[name].module}")
    return module.COMMANDS.get(name) or next(iter(module.COMMANDS.values()))


def read_command(name: str, options: Sequence[str]) -> Any:
    """A command with its options, ready to ``run``; a ``ValueError`` says in one line what cannot be read."""
    module, prog = import_module(f"arcade_torch.tools.commands.{COMMANDS[name].module}"), f"arcade-torch {name}"
    command = module.parse(options, prog) if hasattr(module, "parse") else parse(command_class(name), options, prog)
    command.argv = tuple(options)
    return command


def _run(words: Sequence[str], state: dict[str, Any]) -> int:
    name, options = split_command(words)
    load_extensions(state["imports"])
    state["command"] = read_command(name, options)
    return int(state["command"].run() or EXIT_OK)


def _report(error: Exception) -> int:
    """Say what went wrong; returns the exit code."""
    if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("arcade_torch"):
        _say(missing_package_message(str(error.name)))
        return EXIT_BAD_INPUT
    if is_told(error):
        _say(one_line(error))
        return EXIT_FAILED if type(error).__name__ in WORK_FAILED else EXIT_BAD_INPUT
    _say("this is a fault of arcade-torch; please report it with what follows")
    traceback.print_exc()
    return EXIT_FAILED


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``arcade-torch``.

    Args:
        argv: the words after the program's name; those of the process by default.

    Returns:
        The exit code: 0 done, 1 something failed, 2 bad input, 130 interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug, state = "--debug" in words, dict[str, Any]()
    previous = signal.signal(signal.SIGTERM, _terminate) if argv is None else None
    try:
        state["imports"], words = take_imports([word for word in words if word != "--debug"])
        groups = {name.split()[0] for name in COMMANDS if " " in name}
        if not words or words[0] in HELP or (words[0] in groups and len(words) == 2 and words[1] in HELP):
            print(usage())
        elif words[0] == "--version":
            from arcade_torch import __version__

            print(f"arcade-torch {__version__}")
        else:
            return _run(words, state)
    except SystemExit as stop:
        if not stop.code:
            print(EVERYWHERE)
        return stop.code if isinstance(stop.code, int) else EXIT_OK if stop.code is None else EXIT_FAILED
    except KeyboardInterrupt:
        hint = getattr(state.get("command"), "resume_hint", None)
        _say("stopped; " + (hint() if hint else "nothing was left half written"))
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    except Exception as error:
        if debug:
            raise
        return _report(error)
    finally:
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)
    return EXIT_OK
