"""``python -m arcade_torch.tools.worker``: a process of a study that carries out one run after the
other.

Each line of stdin is JSON: the words of a command line, and the log that takes what the command
prints. Each is answered with a line on stdout. A command that fails ends the process with its exit
code, since it may have left something behind; so does the end of stdin.
"""

import json
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from arcade_torch import program
from arcade_torch.agents.runs.files import open_append
from arcade_torch.tools.cli import EXIT_FAILED, EXIT_OK, begin, main
from arcade_torch.tools.machine import watch_parent
from arcade_torch.tools.studies.processes import DONE, FAILED


def serve(command: Callable[[Sequence[str]], int] = main) -> None:
    """Carry out the orders on stdin; does not return.

    Args:
        command: carries out the words of a command line, and returns the exit code.
    """
    begin()
    watch_parent()
    orders = os.fdopen(os.dup(0))
    answers = os.dup(1)
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)  # a command has no input, nor have programs that it starts
    code = EXIT_OK
    for line in orders:
        order = json.loads(line)
        with open_append(Path(order["log"])) as log:
            _print_to(log.fileno())
        with warnings.catch_warnings():  # of a run before are given again, into its own log
            sys.argv = ["arcade-torch", *order["words"]]  # what a run notes of its beginning
            code = _carry_out(command, order["words"], answers)
        if code != EXIT_OK:
            break
        program.wait_for_work()
        _print_to(nowhere)
        os.write(answers, DONE)
    program.leave(code)


def _carry_out(command: Callable[[Sequence[str]], int], words: Sequence[str], answers: int) -> int:
    """Carry out one command, and answer where it has failed: what the log ends with says why."""
    code = EXIT_FAILED
    try:
        code = command(words)
    finally:
        if code != EXIT_OK:
            os.write(answers, FAILED)
    return code


def _print_to(file: int) -> None:
    """Send both standard streams to an open file."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.dup2(file, 1)
    os.dup2(file, 2)


if __name__ == "__main__":
    serve()
