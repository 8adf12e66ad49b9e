"""Which errors are bad input, printed in one line, and which are faults of ours, printed with their
traceback; optional packages, imported on first use.
"""

import errno
import os
import re
import sys
from importlib import import_module
from typing import Any

from arcade_torch.process import missing_platform
from arcade_torch.tools.text import printable

EXTRA_OF = {
    "tyro": "tools",
    "rich": "tools",
    "matplotlib": "tools",
    "jinja2": "tools",
    "PIL": "tools",
    "pygame": "play",
    "imageio_ffmpeg": "video",
    "wandb": "loggers",
    "tensorboard": "loggers",
    "ray": "ray",
    "huggingface_hub": "hub",
}
"""Import name -> the extra of arcade-torch that brings it."""


class MissingPackage(ImportError):
    """An optional package is not installed; the message says how to get it.

    Example:
        >>> str(MissingPackage("jinja2"))
        "the package jinja2 is missing: pip install '.[tools]'"
    """

    def __init__(self, name: str) -> None:
        top = name.partition(".")[0]
        wanted = f"'.[{EXTRA_OF[top]}]'" if top in EXTRA_OF else top
        super().__init__(f"the package {top} is missing: pip install {wanted}")


WITH_OPTIONS = ("arcade_torch.envs_jax.", "arcade_torch.models.")
"""Packages whose functions take options by name: a ``TypeError`` that they raise is about one."""

FILES = (FileNotFoundError, FileExistsError, PermissionError, NotADirectoryError, IsADirectoryError)

WORK_FAILED = ("NonFiniteError", "ClusterLostError", "DiskFullError")
"""Own error types that do not mean bad input; told in one line too."""

_FULL = "make room and type the same again; what was finished before is whole"
_TOO_LARGE = "a file may not grow so large here: raise the limit with ulimit -f"
_FORBIDDEN = "choose another folder (--out), or let it be written"
_NOT_ALLOWED = "choose another place (--out), or change its permissions"
MACHINE = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _TOO_LARGE,
    errno.EROFS: _FORBIDDEN,
    errno.EACCES: _NOT_ALLOWED,
    errno.EPERM: _NOT_ALLOWED,
    errno.EMFILE: "too many files are open at once: raise the limit with ulimit -n",
    errno.ENFILE: "too many files are open at once on this machine",
    errno.EIO: "the disk, or the network it is on, failed",
    errno.ESTALE: "the folder was replaced on the server: name it again",
    errno.ENOMEM: "there is not enough memory",
}
"""What the machine may refuse, and what helps."""


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
    """Whether an error is told in one line: one of our own types, something about a file, or an
    argument that our code refuses.

    All layers refuse arguments with a ``ValueError``, because all are used without the command line
    too. Games and memory models refuse options with a ``TypeError``, as Python does. The same types
    raised by a library, and a ``TypeError`` anywhere else, are faults.
    """
    if type(error).__module__.startswith("arcade_torch."):
        return True
    if isinstance(error, OSError) and not isinstance(error, ValueError):
        is_named = error.errno is not None and error.filename is not None
        return isinstance(error, FILES) or is_named or error.errno in MACHINE
    if is_unnameable(error):
        return True
    if isinstance(error, ValueError):
        return _raising_module(error).startswith("arcade_torch.")
    if isinstance(error, TypeError):
        return _raising_module(error).startswith(WITH_OPTIONS)
    return False


def is_unnameable(error: BaseException) -> bool:
    """Whether a file could not be opened because this shell's locale has no way to write its
    name.
    """
    encoding = sys.getfilesystemencoding()
    return (
        isinstance(error, UnicodeEncodeError)
        and encoding != "utf-8"
        and error.encoding in (encoding, encoding.removeprefix("us-"))
    )


def _raising_module(error: BaseException) -> str:
    """The name of the module whose code raised an error."""
    place = error.__traceback__
    if place is None:
        return ""
    while place.tb_next is not None:
        place = place.tb_next
    return str(place.tb_frame.f_globals.get("__name__"))


def is_of_the_machine(error: BaseException) -> bool:
    """Whether work failed because of this machine or of the work itself, and not because of what
    was asked for.
    """
    if type(error).__name__ in WORK_FAILED:
        return True
    is_ours = type(error).__module__.startswith("arcade_torch.")
    cause = error.__cause__ if is_ours else error  # of a run whose disk is full, for one
    return (
        isinstance(cause, OSError)
        and cause.errno in MACHINE
        and not isinstance(cause, PermissionError)
    )


def one_line(error: BaseException) -> str:
    """The message of an error in one line, or its type if it has none."""
    if isinstance(error, UnicodeEncodeError) and is_unnameable(error):
        return printable(
            f"the name {error.object} cannot be written in this shell's {error.encoding}: set "
            "PYTHONUTF8=1, or LC_ALL=C.UTF-8"
        )
    if isinstance(error, OSError) and not type(error).__module__.startswith("arcade_torch."):
        return printable(_of_a_file(error))
    return printable(" ".join(str(error).split())) or type(error).__name__


def _of_a_file(error: OSError) -> str:
    """What an operating system says of a file: which one, why not, and what helps."""
    if error.errno is None or error.strerror is None:
        return " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        return f"{error.filename} does not exist"
    place = "a file" if error.filename is None else str(error.filename)
    verb = "write" if MACHINE.get(error.errno) in (_FULL, _TOO_LARGE, _FORBIDDEN) else "use"
    advice = MACHINE.get(error.errno)
    if advice == _NOT_ALLOWED and os.path.exists(place) and not os.access(place, os.R_OK):
        advice = "change its permissions"  # it was to be read
    return f"could not {verb} {place}: {error.strerror}" + (f"; {advice}" if advice else "")


def reason(error: BaseException) -> str:
    """Why something failed, in one line."""
    says = one_line(error)
    kind = type(error).__name__
    return says if is_told(error) or says == kind else f"{kind}: {says}"


_JAX_SETTING = re.compile("for (environment 'JAX_|JAX flag jax_)")
"""In what JAX says of a value in an environment variable of its own."""


def trouble_of_the_machine(error: BaseException) -> str:
    """What this machine or shell lacks, or asks for, if that is why JAX or torch raised an error;
    empty if it is not.
    """
    if isinstance(error, Warning):
        return (
            "Python was told to stop at warnings (-W error, PYTHONWARNINGS), and one came: "
            f"{type(error).__name__}: {one_line(error)[:200]}; leave that away, or except this one "
            f"(-W default::{type(error).__name__} behind it)"
        )
    said = str(error)
    short = (
        "RESOURCE_EXHAUSTED",
        "out of memory",
        "can't allocate memory",
        "Unable to allocate",
        "std::bad_alloc",
    )
    if isinstance(error, MemoryError) or any(words in said for words in short):
        return f"there is not enough memory: ask for less at once ({one_line(error)[:200]})"
    if (
        sys.flags.optimize > 1
        and isinstance(error, TypeError | AttributeError)
        and "NoneType" in said
    ):
        return (
            "TorchRL cannot be loaded by a Python without docstrings: start it with -O in the "
            "place of -OO"
        )
    if "Disallowed" in said and "transfer" in said:
        return (
            "JAX's transfer guard forbids what games need, actions and frames that move between "
            f"host and device: unset JAX_TRANSFER_GUARD ({one_line(error)[:200]})"
        )
    if isinstance(error, ValueError) and _JAX_SETTING.search(said):
        return f"JAX refuses a setting of this shell: {one_line(error)[:200]}"
    return missing_platform()
