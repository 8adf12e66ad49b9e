"""The command line ``arcade-torch``.

The first words choose a command, only then is its module imported: help and typing errors stay quick.
Each command is a dataclass in `arcade_torch.tools.commands`: its fields are the options, its docstring is the help, and
its `run` does the work.
"""

import difflib
import os
import re
import signal
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr
from importlib import import_module
from io import StringIO
from typing import Any, NamedTuple

from arcade_torch.tools.extensions import load_extensions, take_imports
from arcade_torch.tools.optional import MissingPackage, missing_package_message, need

EXIT_OK, EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130

BAD_INPUT = (
    ValueError,
    TypeError,
    FileNotFoundError,
    FileExistsError,
    PermissionError,
    NotADirectoryError,
    IsADirectoryError,
    MissingPackage,
)
"""What the library raises at its border, beside its own error types; shown as one line."""

WORK_FAILED = ("NonFiniteError", "ClusterLostError")
"""Own error types that do not mean bad input."""


EVERYWHERE = (
    "With any command: --import FILE.py (or MODULE) first imports what registers your own games or memory models;",
    "--debug shows the traceback of an error.",
)


class Command(NamedTuple):
    """Where a command lives and what it does in a few words."""

    module: str
    summary: str


COMMANDS: dict[str, Command] = {
    "demo": Command("demo", "small study of one game: learning, gap, bias and saliency in one HTML page"),
    "list": Command("list", "the registered environments and memory models"),
    "baselines": Command("baselines", "what random play and the scripted players earn in each game"),
    "sheet": Command("sheet", "one picture of all games, both twins"),
    "train": Command("train", "train one agent into a run folder"),
    "evaluate": Command("evaluate", "greedy returns of a trained agent"),
    "study": Command("study", "run a grid of trainings from one TOML file, resumable run by run"),
    "report": Command("report", "write the HTML page of a study"),
    "analyze gap-bias": Command("gap_bias", "observability gap and memory bias with intervals"),
    "analyze saliency": Command("saliency", "which past pixels the current decision depends on"),
    "analyze recall-density": Command("recall_density", "how decisions spread over the past of their episodes"),
    "analyze contamination": Command("contamination", "what one noisy past frame does to later decisions"),
    "figure": Command("figure", "draw one of the paper's figures from run folders"),
    "play": Command("play", "play a game by hand, in a window or in the terminal"),
    "record": Command("record", "a GIF or MP4 of a random, scripted or trained player"),
    "bench all": Command("bench_all", "every benchmark into one file, and a page of its tables"),
    "bench compare": Command("bench_compare", "what became better or worse between two such files"),
    "bench envs": Command("bench_envs", "frames per second of the games, every frame consumed"),
    "bench train": Command("bench_train", "frames per second of training, and where the time goes"),
    "bench seeds": Command("bench_seeds", "several seeds in one process against one after the other"),
    "bench memory": Command("bench_memory", "time and memory of the memory models and of the scans behind them"),
    "bench saliency": Command(
        "bench_saliency", "saliency maps in two stages against the whole network action by action"
    ),
    "bench recall": Command("bench_recall", "delayed recall: which model remembers one symbol for how long"),
}


def usage() -> str:
    """The page that ``arcade-torch --help`` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "usage: arcade-torch COMMAND [options]",
            "",
            "POPGym Arcade for PyTorch: pixel games as MDP/POMDP twins, and what memory does in them.",
            "",
            *lines,
            "",
            "arcade-torch COMMAND --help explains a command and gives an example.",
            *EVERYWHERE,
            "--version prints the version.",
        ]
    )


def split_command(words: Sequence[str]) -> tuple[str, list[str]]:
    """Separate the name of the command from its options.

    Args:
        words: the command line without the program's name.

    Returns:
        A key of `COMMANDS` and the remaining words.

    Raises:
        ValueError: there is no such command; names the nearest.

    Example:
        >>> split_command(["analyze", "gap-bias", "runs/demo"])
        ('analyze gap-bias', ['runs/demo'])
    """
    for length in (2, 1):
        name = " ".join(words[:length])
        if len(words) >= length and name in COMMANDS:
            return name, list(words[length:])
    groups = sorted({name.split()[0] for name in COMMANDS if " " in name})
    if words[0] in groups:
        members = [name.split()[1] for name in COMMANDS if name.startswith(words[0] + " ")]
        got = f"not {words[1]!r}" if len(words) > 1 and not words[1].startswith("-") else "and which one is missing"
        raise ValueError(f"arcade-torch {words[0]} is followed by {' or '.join(members)}, {got}")
    near = difflib.get_close_matches(words[0], [*COMMANDS, *groups], n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"unknown command {words[0]!r}: {hint}commands are {', '.join(COMMANDS)}")


_RULE = re.compile(r"[\u2500-]{4,}")
_FRAME = re.compile(r"^[\u2502\u256d\u2570|+]\s?|\s?[\u2502\u256e\u256f|+]$")
_TITLE = re.compile(r"Unrecognized options|Value error|Required options|Invalid choice|Parsing error")


def flatten_parser_message(text: str, prog: str) -> str:
    """Turn the framed message of the option parser into one line.

    Args:
        text: what the parser wrote to stderr.
        prog: the command, for example ``arcade-torch train``.
    """
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    sections: list[list[str]] = [[]]
    for raw in text.splitlines():
        line = _FRAME.sub("", raw.strip()).strip()
        if _RULE.fullmatch(line):
            sections.append([])
        elif line and line[:2] not in ("\u2500 ", "- "):  # the frame's title repeats what follows
            sections[-1].append(line)
    sections = [part for part in sections if part]
    if sections and len(sections[0]) == 1 and len(sections) > 1 and _TITLE.fullmatch(sections[0][0]):
        sections = sections[1:]  # a title without a frame
    head = " ".join(sections[0]) if sections else "the options could not be read"
    near = [part for part in sections[1:] if part[0].startswith("Perhaps you meant")]
    if near and len(near[0]) > 1:
        head += f"; perhaps you meant {near[0][1]}"
    return f"{head.rstrip('.')} (see {prog} --help)"


def parse(kind: Any, words: Sequence[str], prog: str, default: Any = None) -> Any:
    """Read options into a dataclass.

    Args:
        kind: the dataclass.
        words: the options.
        prog: the command, for messages.
        default: instance whose values stand where no option is given.

    Raises:
        ValueError: an option is unknown, missing or malformed; one line.
        SystemExit: help was asked for.
    """
    tyro = need("tyro")
    captured = StringIO()
    try:
        with redirect_stderr(captured):
            extra = {} if default is None else {"default": default}
            return tyro.cli(kind, args=list(words), prog=prog, config=(tyro.conf.FlagCreatePairsOff,), **extra)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ValueError(flatten_parser_message(captured.getvalue(), prog)) from None


def one_line(error: BaseException) -> str:
    """The message of an error without line breaks, or its type if it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def _say(text: str) -> None:
    print(f"arcade-torch: {text}", file=sys.stderr)


def _terminate(signum: int, frame: object) -> None:
    raise KeyboardInterrupt


def _run(name: str, words: Sequence[str], state: dict[str, Any]) -> int:
    module = import_module(f"arcade_torch.tools.commands.{COMMANDS[name].module}")
    prog = f"arcade-torch {name}"
    command = module.parse(words, prog) if hasattr(module, "parse") else parse(module.COMMAND, words, prog)
    state["command"] = command
    return int(command.run() or EXIT_OK)


def _guarded(name: str, words: Sequence[str], imports: Sequence[str], debug: bool) -> int:
    state: dict[str, Any] = {}
    try:
        load_extensions(imports)
        return _run(name, words, state)
    except SystemExit as stop:
        if not stop.code:
            print(*EVERYWHERE, sep="\n")
        return stop.code if isinstance(stop.code, int) else EXIT_OK if stop.code is None else EXIT_FAILED
    except KeyboardInterrupt:
        tell = getattr(state.get("command"), "how_to_go_on", None)
        _say("stopped; " + (tell() if tell else "nothing was left half written"))
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return EXIT_OK
    except Exception as error:
        if debug:
            raise
        if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("arcade_torch"):
            _say(missing_package_message(str(error.name)))
            return EXIT_BAD_INPUT
        if isinstance(error, BAD_INPUT) or type(error).__module__.startswith("arcade_torch."):
            _say(one_line(error))
            return EXIT_FAILED if type(error).__name__ in WORK_FAILED else EXIT_BAD_INPUT
        _say(f"internal error: {type(error).__name__}: {one_line(error)}; rerun with --debug to see where")
        return EXIT_FAILED


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``arcade-torch``.

    Args:
        argv: the words after the program's name; those of the process by default.

    Returns:
        The exit code: 0 done, 1 something failed, 2 bad input, 130 interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        imports, words = take_imports(words)
    except ValueError as error:
        _say(one_line(error))
        return EXIT_BAD_INPUT
    if not words or words[0] in ("-h", "--help", "help"):
        print(usage())
        return EXIT_OK
    if words[0] == "--version":
        from arcade_torch import __version__

        print(f"arcade-torch {__version__}")
        return EXIT_OK
    if len(words) == 2 and words[1] in ("-h", "--help") and any(name.startswith(words[0] + " ") for name in COMMANDS):
        print(usage())
        return EXIT_OK
    try:
        name, options = split_command(words)
    except ValueError as error:
        _say(one_line(error))
        return EXIT_BAD_INPUT
    previous = signal.signal(signal.SIGTERM, _terminate) if argv is None else None
    try:
        return _guarded(name, options, imports, debug)
    finally:
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)
