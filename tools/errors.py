"""Which errors are bad input, told in one line, and which are faults of ours, shown with their traceback."""

import opcode

from arcade_torch.tools.optional import MissingPackage

BAD_INPUT = (
    *(ValueError, TypeError, MissingPackage, FileNotFoundError, FileExistsError),
    *(PermissionError, NotADirectoryError, IsADirectoryError),
)
"""What the library raises for bad input, beside its own error types."""

WORK_FAILED = ("NonFiniteError", "ClusterLostError", "DiskFullError")
"""Own error types that do not mean bad input; told in one line too."""


def is_told(error: BaseException) -> bool:
    """Whether an error is told in one line: one of our own types, a file that is not there, or a refusal of ours.

    A ``ValueError`` or ``TypeError`` is a refusal only if a ``raise`` statement of this package raised it; one that
    comes out of an operation, or out of a library, is a fault.
    """
    if type(error).__module__.startswith("arcade_torch."):
        return True
    if not isinstance(error, ValueError | TypeError):
        return isinstance(error, BAD_INPUT)
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
