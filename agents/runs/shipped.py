"""The folders of the agents that this package ships, by name; imports nothing heavy."""

import difflib
import os
from os import PathLike
from pathlib import Path

SHIPPED = Path(__file__).resolve().parents[1] / "shipped"
"""Where they are: a folder each."""


def pretrained_names() -> list[str]:
    """Names of the agents that this package ships, ``GAME-TWIN-MEMORY``, sorted.

    Example:
        >>> "signpost-partial-lru" in pretrained_names()
        True
    """
    return sorted(path.parent.name for path in SHIPPED.glob("*/model.safetensors"))


def is_shipped(path: Path) -> bool:
    """Whether a path is the folder of an agent of this package, where nothing is written."""
    return path.parent.absolute() == SHIPPED


def agent_folder(name: str | PathLike[str]) -> Path:
    """The folder that a user means: one that is there, or an agent of this package by its name.

    Anything else is given back as it is, for whoever opens it to say that it is not there.
    """
    path = Path(name)
    text = os.fspath(name)
    if text in pretrained_names() and not path.exists():
        return SHIPPED / text
    return path


def no_folder(path: Path) -> str:
    """What is wrong with a path that is no folder."""
    return f"{path} {'is not a folder' if path.exists() else 'does not exist'}"


def agents_hint(folder: Path) -> str:
    """What to give in the place of a folder that is not there; the nearest name first."""
    names = pretrained_names()
    near = difflib.get_close_matches(folder.name, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    if len(folder.parts) == 2 and not folder.parent.exists():
        hint += (
            "an agent of that name on the Hugging Face hub is fetched first, arcade-torch pull "
            f"{folder}; "
        )
    return (
        f"{hint}give a run folder, one of its checkpoints, an agent that was shared, or one of "
        f"this package: {', '.join(names)}"
    )
