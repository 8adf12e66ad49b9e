"""Import optional packages on first use; if one is missing, say which extra installs it."""

from importlib import import_module
from typing import Any

EXTRA_OF = {
    **dict.fromkeys(("tyro", "rich", "tqdm", "matplotlib", "jinja2", "PIL"), "tools"),
    **{"pygame": "play", "imageio_ffmpeg": "video", "wandb": "loggers", "tensorboard": "loggers", "ray": "ray"},
}
"""Import name -> the extra of arcade-torch that brings it."""


class MissingPackage(ImportError):
    """An optional package is not installed; the message says how to get it."""


def missing_package_message(name: str) -> str:
    """One line that says which package is missing and how to install it.

    Example:
        >>> missing_package_message("jinja2")
        "the package jinja2 is missing: pip install 'arcade-torch[tools]'"
    """
    top = name.partition(".")[0]
    wanted = f"'arcade-torch[{EXTRA_OF[top]}]'" if top in EXTRA_OF else top
    return f"the package {top} is missing: pip install {wanted}"


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
        raise MissingPackage(missing_package_message(name)) from error
