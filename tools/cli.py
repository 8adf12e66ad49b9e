"""The command line ``arcade-torch``.

The first words choose a command, only then is its module imported: help and typing errors stay
quick. Each command is a dataclass in `arcade_torch.tools.commands`: its fields are the options, its
docstring is the help, and its `run` does the work.
"""

import difflib
import os
import shutil
import sys
import textwrap
import traceback
import warnings
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any

from arcade_torch import program
from arcade_torch.tools.bench.registry import BENCHES
from arcade_torch.tools.errors import (
    MissingPackage,
    is_of_the_machine,
    is_told,
    one_line,
    reason,
    trouble_of_the_machine,
)
from arcade_torch.tools.figures.catalogue import FIGURES
from arcade_torch.tools.imports import import_for_command, imported, take_imports
from arcade_torch.tools.programs import keep_programs
from arcade_torch.tools.text import printable, warn

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = program.EXIT_STOPPED

HELP = ("-h", "--help", "help")
EVERYWHERE = """\
With any command: --import FILE.py (or MODULE) first imports what registers your
own games or memory models; --debug shows the traceback of an error."""

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (
        "study.Demo",
        "small study of two games: learning, gap, bias and saliency in one HTML page",
    ),
    "list": (
        "list.List",
        "games, memory models, what scripted players earn, and pictures of the games",
    ),
    "new memory": ("new.NewMemory", "a file with a memory model to change, that works as it is"),
    "train": ("train.Train", "train one agent into a run folder"),
    "evaluate": ("train.Evaluate", "greedy returns of a trained agent"),
    "study": (
        "study.StudyCommand",
        "run a grid of trainings from one TOML file, resumable run by run",
    ),
    "compare": (
        "compare.Compare",
        "a memory model of yours against others: a small study of some minutes, and its report",
    ),
    "report": ("study.Report", "write the HTML page of a study"),
    "card": (
        "card.Card",
        "what there is to say of a memory model: laws, cost, reach and recall, on one page",
    ),
    **{
        f"analyze {name}": ("figure.Figure", entry.summary)
        for name, entry in FIGURES.items()
        if entry.analysis
    },
    **{f"figure {name}": ("figure.Figure", entry.summary) for name, entry in FIGURES.items()},
    "leaderboard submit": (
        "leaderboard.Submit",
        "evaluate the runs of one agent by the protocol, and write its entry",
    ),
    "leaderboard check": (
        "leaderboard.Check",
        "evaluate an entry again, and refuse what does not agree",
    ),
    "leaderboard page": ("leaderboard.Page", "write the tables of docs/leaderboard.md"),
    "play": ("play.Play", "play a game by hand, in a window or in the terminal"),
    "record": ("play.Record", "a GIF or MP4 of a random, scripted or trained player"),
    "push": ("share.Push", "put a trained agent on the Hugging Face hub, or into a folder"),
    "pull": ("share.Pull", "fetch an agent from the hub, or from a folder, and check it"),
    **{f"bench {name}": ("bench.Bench", summary) for name, summary in BENCHES.items()},
    "bench all": ("bench.BenchAll", "every benchmark into one file, and a page of its tables"),
    "bench compare": ("bench.BenchCompare", "what became better or worse between two such files"),
}
"""Name -> module and class in `arcade_torch.tools.commands`, and what it does in a few words."""
GROUPS: dict[str, list[str]] = {}
"""First word of commands of two words -> the second ones."""
for _name in COMMANDS:
    _group, _, _second = _name.partition(" ")
    if _second:
        GROUPS.setdefault(_group, []).append(_second)


def usage() -> str:
    """The page that ``arcade-torch --help`` prints."""
    longest = max(map(len, COMMANDS))
    columns = shutil.get_terminal_size(fallback=(999, 24)).columns  # lines stay whole for grep
    commands = "\n".join(
        textwrap.fill(
            f"  {name:<{longest}}  {summary}",
            width=max(columns, longest + 30),
            subsequent_indent=" " * (longest + 4),
        )
        for name, (_, summary) in COMMANDS.items()
    )
    return f"""usage: arcade-torch COMMAND [options]

POPGym Arcade for PyTorch: pixel games as MDP/POMDP twins, and what memory does
in them.

{commands}

arcade-torch COMMAND --help explains a command and gives an example.
{EVERYWHERE}
--version prints the version."""


def split_command(words: Sequence[str]) -> tuple[str, list[str]]:
    """Separate the name of the command from its options; a ``ValueError`` names the nearest if
    there is none.

    Example:
        >>> split_command(["analyze", "gap-bias", "runs/demo"])
        ('analyze gap-bias', ['runs/demo'])
    """
    for length in (2, 1):
        name = " ".join(words[:length])
        if len(words) >= length and name in COMMANDS:
            return name, list(words[length:])
    group, *more = words
    if group not in GROUPS:
        near = _nearest(group, [*COMMANDS, *GROUPS])
        raise ValueError(f"unknown command {group!r}: {near}commands are {', '.join(COMMANDS)}")
    members = GROUPS[group]
    if more and (near := _nearest(more[0], members)):
        raise ValueError(f"unknown {group} {more[0]!r}: {near}There are {', '.join(members)}")
    got = f"not {more[0]!r}" if more and not more[0].startswith("-") else "and which one is missing"
    raise ValueError(f"arcade-torch {group} is followed by {' or '.join(members)}, {got}")


def _nearest(word: str, names: Iterable[str]) -> str:
    near = difflib.get_close_matches(word, list(names), n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}? " if near else ""


def _say(text: str) -> None:
    warn(f"arcade-torch: {text}")


def command_class(name: str) -> Any:
    """The dataclass of a command; `parse` reads its options and `run` does the work."""
    module, kind = COMMANDS[name][0].split(".")
    return getattr(import_module(f"arcade_torch.tools.commands.{module}"), kind)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``arcade-torch``.

    Args:
        argv: the words after the program's name. Without them the words are those of the process,
            which then ends here with the exit code.

    Returns:
        The exit code: 0 done, 1 something failed, 2 bad input, 130 stopped by a signal.
    """
    if argv is not None:
        return _run(list(argv))
    begin()
    program.leave(_run(sys.argv[1:]))


def begin() -> None:
    """Prepare a process that carries out commands: its streams, its signals, its warnings, and
    where it keeps what it compiles.
    """
    program.begin()
    warnings.formatwarning = _format_warning
    keep_programs()


def _run(words: list[str]) -> int:
    """Run a command line, and tell what goes wrong."""
    debug = "--debug" in words
    begun: list[Any] = []
    try:
        code = _carry_out([word for word in words if word != "--debug"], begun)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return _tell_stopped(begun)
    except Exception as error:
        if program.is_asked_to_stop():  # a library turned the interruption into an error of its own
            return _tell_stopped(begun)
        if debug and not isinstance(error, BrokenPipeError):
            raise
        return _tell(error)


def _carry_out(words: Sequence[str], begun: list[Any]) -> int:
    """Print a page, or run a command, which is added to ``begun`` before; returns the exit code."""
    try:
        imports, words = take_imports([_with_home(word) for word in words])
        if _is_page(words):
            _print_page(words)
            return EXIT_OK
        command = _parse(words, imports)
        begun.append(command)
        with program.working(command.resume_hint()):
            code = int(command.run() or EXIT_OK)
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):  # this is what rich makes of it
            return EXIT_OK
        if begun:  # none of our commands ends so, but a memory model of somebody's may
            return _tell(stop)
        if stop.code:
            return stop.code if isinstance(stop.code, int) else EXIT_FAILED
        print(EVERYWHERE)  # below the help of a command
        return EXIT_OK
    # something swallowed the interruption, and then the work was over
    if program.is_asked_to_stop():
        raise KeyboardInterrupt
    return code


def _with_home(word: str) -> str:
    """A word of the command line; in ``--out=~/runs`` shells leave the ``~`` as it is, and a folder
    of that name would be written.
    """
    option, equals, value = word.partition("=")
    if equals and option.startswith("--"):
        return f"{option}={os.path.expanduser(value)}"
    return os.path.expanduser(word)


def _is_page(words: Sequence[str]) -> bool:
    """Whether these words ask for a page that is printed, and for no command."""
    if not words or words[0] in HELP or words[0] == "--version":
        return True
    return words[0] in GROUPS and len(words) == 2 and words[1] in HELP


def _print_page(words: Sequence[str]) -> None:
    if words[:1] == ["--version"]:
        from arcade_torch import __version__

        print(f"arcade-torch {__version__}")
    else:
        print(usage())


def _parse(words: Sequence[str], imports: Sequence[str]) -> Any:
    """The command that a command line asks for, with its options."""
    name, options = split_command(words)
    _check_current_folder()
    import_for_command(imports)
    command = command_class(name).parse(options, f"arcade-torch {name}")
    command.argv = tuple(options)
    return command


def _check_current_folder() -> None:
    """Refuse to work in a folder that was removed: libraries end the process there, with messages
    about something else.
    """
    try:
        os.getcwd()
    except FileNotFoundError:
        raise ValueError(
            "the current folder is not there any more: change to another, such as with cd ~"
        ) from None


def _tell_stopped(begun: Sequence[Any]) -> int:
    _say("stopped; " + (begun[0].resume_hint() if begun else "no work was begun"))
    return EXIT_INTERRUPTED


def _tell(error: BaseException) -> int:
    """Say what went wrong, in one line unless it is a fault, where that is the last line; returns
    the exit code.
    """
    if isinstance(error, BrokenPipeError):  # the reader of stdout, such as head, has what it wanted
        _close_stdout()
        return EXIT_OK
    if (
        is_of_the_machine(error)
        and isinstance(error, OSError)
        and error.filename is None
        and _is_stdout_full()
    ):
        _say(
            f"could not write to standard output: {error.strerror}; what was written to files is "
            "whole"
        )
        return EXIT_FAILED
    if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("arcade_torch"):
        error = MissingPackage(str(error.name))
    if is_told(error):
        _say(one_line(error))
        return EXIT_FAILED if is_of_the_machine(error) else EXIT_BAD_INPUT
    if lack := trouble_of_the_machine(error):
        _say(lack)
        return EXIT_FAILED
    passed = {
        (at.f_code.co_filename, at.f_globals["__name__"])
        for at, _ in traceback.walk_tb(error.__traceback__)
    }
    modules_of_user = [name for name in imported() if any(name in names for names in passed)]
    if modules_of_user:
        _say(f"{modules_of_user[0]} failed:")
    else:
        _say("this is a fault of arcade-torch; please report it with what follows")
    lines = "".join(traceback.format_exception(error)).rstrip("\n").split("\n")
    for line in lines:
        warn(line)
    why = reason(error)
    if lines[-1] != why:  # a note of a library, or a message of several lines
        _say(why)
    return EXIT_FAILED


def _close_stdout() -> None:
    """Send to nowhere what would be printed from now on, so that ending does not fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _is_stdout_full() -> bool:
    """Whether nothing can be printed any more, such as into a file on a full disk."""
    try:
        print(flush=True)
    except OSError:
        _close_stdout()
        return True
    return False


def _format_warning(
    message: Any, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """A warning in one line, without the line of source that gave it."""
    return f"{category.__name__}: {printable(message)} ({printable(filename)}:{lineno})\n"
