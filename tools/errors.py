"""Which errors are bad input, told in one line, and which are faults of ours; optional packages, imported when used."""

import opcode
from importlib import import_module
from typing import Any

EXTRA_OF = {
    **dict.fromkeys(("tyro", "rich", "matplotlib", "jinja2", "PIL"), "tools"),
    **{"pygame": "play", "imageio_ffmpeg": "video", "wandb": "loggers", "tensorboard": "loggers", "ray": "ray"},
}
"""Import name -> the extra of arcade-torch that brings it."""


class MissingPackage(ImportError):
    """An optional package is not installed; the message says how to get it.

    Example:
        >>> str(MissingPackage("jinja2"))
        "the package jinja2 is missing: pip install 'arcade-torch[tools]'"
    """

    def __init__(self, name: str) -> None:
        top = name.partition(".")[0]
        wanted = f"'arcade-torch[{EXTRA_OF[top]}]'" if top in EXTRA_OF else top
        super().__init__(f"the package {top} is missing: pip install {wanted}")


FILES = (FileNotFoundError, FileExistsError, PermissionError, NotADirectoryError, IsADirectoryError)

WORK_FAILED = ("NonFiniteError", "ClusterLostError", "DiskFullError")
"""Own error types that do not mean bad input; told in one line too."""


def need(name: str) -> Any:
    """Import and return an optional module.

    Raises:
        MissingPackage: it is not installed; names the extra that brings it.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.partition(".")[0] != name.partition(".")[0]:
            raise
        raise MissingPackage(name) from error


def is_told(error: BaseException) -> bool:
    """Whether an error is told in one line: one of our own types, a file that is not there, or a refusal of ours.

    A ``ValueError`` or ``TypeError`` is a refusal only if a ``raise`` statement of this package raised it; one that
    comes out of an operation, or out of a library, is a fault.
    """
    if type(error).__module__.startswith("arcade_torch."):
        return True
    if not isinstance(error, ValueError | TypeError):
        return isinstance(error, FILES)
    at = error.__traceback__
    while at is not None and at.tb_next is not None:
        at = at.tb_next
    if at is None or not str(at.tb_frame.f_globals.get("__name__")).startswith("arcade_torch."):
        return False
    return at.tb_frame.f_code.co_code[at.tb_lasti] == opcode.opmap["RAISE_VARARGS"]


def one_line(error: BaseException) -> str:
    """The message of an error without line breaks, or its type if it has none."""
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        return f"{error.filename} does not exist"
    return " ".join(str(error).split()) or type(error).__name__


def reason(error: BaseException) -> str:
    """Why something failed, in one line."""
    return one_line(error) if is_told(error) else f"{type(error).__name__}: {one_line(error)}"
