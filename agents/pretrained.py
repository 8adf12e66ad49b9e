"""Agents that are trained already: those that this package ships, those of others in a folder or on
the Hugging Face hub.
"""

import os
from os import PathLike
from pathlib import Path

import torch

from arcade_torch.agents import hub
from arcade_torch.agents.policy import Agent, agent_of
from arcade_torch.agents.runs.bundle import (
    MOST_BYTES,
    check_hash,
    find_checkpoint,
    is_bundle,
    load_bundle,
)
from arcade_torch.agents.runs.checkpoint import Checkpoint
from arcade_torch.agents.runs.files import CheckpointError
from arcade_torch.agents.runs.shipped import agent_folder, agents_hint, no_folder
from arcade_torch.models.presets import FEED_FORWARD
from arcade_torch.models.registry import ALIASES, memory_names


def from_pretrained(
    name: str | PathLike[str],
    revision: str | None = None,
    sha256: str | None = None,
    device: str | torch.device | None = None,
) -> Agent:
    """Load an agent that is trained already.

    Nothing in it is code and nothing is unpickled. A memory model of somebody else's has to be
    registered before: it is not fetched.

    Args:
        name: a folder with an agent, a run folder, one of :func:`pretrained_names`, or a repository
            ``owner/name`` of the Hugging Face hub (the extra ``hub``).
        revision: branch, tag or commit of the repository; the newest commit by default.
        sha256: what the hash of ``model.safetensors`` has to be, checked before it is read.
        device: where to put the network; default the device of the run if it is there, else the
            CPU.

    Returns:
        The agent, in evaluation mode; see :func:`arcade_torch.agents.load`.

    Raises:
        ValueError: ``sha256`` is no hash, ``revision`` is given for a folder, or there is no such
            device.
        CheckpointError: there is no such agent, it is damaged or another one, or its memory model
            is not known here.
        HubError: the hub cannot be reached, or refuses.

    Example:
        >>> agent = from_pretrained("signpost-partial-lru")
        >>> agent.config.env, agent.config.memory
        ('SignpostEasy-v0', 'lru')
    """
    if sha256 is not None:
        check_hash(sha256)
    folder = agent_folder(name)
    if not folder.is_dir() and hub.is_repo(os.fspath(name)):
        fetched = hub.download(os.fspath(name), MOST_BYTES, revision=revision)
        return agent_of(read_fetched(fetched, sha256), device)
    if revision is not None:
        raise ValueError(f"revision = {revision!r}: {name} is a folder here, which has none")
    return agent_of(read_shared(folder, sha256), device)


def read_shared(folder: Path, sha256: str | None = None) -> Checkpoint:
    """The weights and settings in a folder, if its memory model is known; raises as
    :func:`from_pretrained`.
    """
    if not folder.is_dir():
        raise CheckpointError(f"{no_folder(folder)}; {agents_hint(folder)}")
    if sha256 is not None and not is_bundle(folder):
        raise CheckpointError(
            f"{folder} has no model.safetensors: sha256 is for an agent that was shared"
        )
    if not is_bundle(folder):
        return find_checkpoint(folder)
    return _with_known_memory(load_bundle(folder, sha256), folder)


def read_fetched(folder: Path, sha256: str | None) -> Checkpoint:
    """What :func:`arcade_torch.agents.hub.download` put into a folder of the hub's cache, where it
    stays, damaged or not; raises as :func:`from_pretrained`.
    """
    try:
        checkpoint = load_bundle(folder, sha256)
    except CheckpointError as error:
        raise CheckpointError(
            f"{error}; if this copy is damaged, delete {folder.parent.parent} and fetch it again"
        ) from error
    return _with_known_memory(checkpoint, folder)


def _with_known_memory(checkpoint: Checkpoint, folder: Path) -> Checkpoint:
    """Refuse an agent whose memory model is registered nowhere."""
    memory = checkpoint.config.memory
    if memory not in (*memory_names(), *ALIASES, FEED_FORWARD):
        raise CheckpointError(
            f"the memory {memory!r} of the agent in {folder} is not known here, and no code is "
            "taken from an agent: pass --import FILE.py with it, or register_memory before"
        )
    return checkpoint
