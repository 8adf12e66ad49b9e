"""An agent to share: two files in a folder, in the conventions of the Hugging Face hub.

``model.safetensors`` holds the weights, ``config.json`` says what they are the weights of. The
header of the weights names the SHA-256 of ``config.json``: who knows the hash of the weights knows
both files. Nothing in them is code, and nothing is unpickled.
"""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.runs.checkpoint import (
    FORMAT,
    MOST_WEIGHTS,
    Checkpoint,
    load_checkpoint,
    load_latest,
    refuse_format,
)
from arcade_torch.agents.runs.files import (
    CheckpointError,
    list_checkpoints,
    read_bytes,
    write_atomic,
)
from arcade_torch.agents.runs.shipped import no_folder

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
MOST_CONFIG = 2**20
"""Bytes of the largest ``config.json`` that is read."""
MOST_BYTES = {CONFIG: MOST_CONFIG, WEIGHTS: MOST_WEIGHTS}
_META = "meta.json"
_HASH = re.compile("[0-9a-f]{64}")
_LENGTH_BYTES = 8
"""At the start of a safetensors file: how long its header is."""


def write_bundle(
    folder: Path, checkpoint: Checkpoint, record: Mapping[str, Any], half: bool = False
) -> str:
    """Write an agent into a folder, which is made.

    Args:
        folder: where to; files of the same names are replaced.
        checkpoint: the agent.
        record: more entries of ``config.json``, JSON values.
        half: store floating-point weights as float16; they are float32 again when they are read.

    Returns:
        SHA-256 of the weights' file, hexadecimal.
    """
    about = {"format": FORMAT, "frames": checkpoint.frames, "config": checkpoint.config.to_dict()}
    config = (json.dumps(about | dict(record), indent=1) + "\n").encode()
    tensors = dict[str, Tensor]()
    for name, value in checkpoint.weights.items():
        stored = value.detach().cpu()
        if half and stored.dtype == torch.float32:
            stored = stored.half()
        tensors[name] = stored.contiguous().clone()
    header = {"format": "pt", "config_sha256": hashlib.sha256(config).hexdigest()}
    if half:
        header["stored_as"] = "float16"
    weights = _in_one_order(save(tensors, header))
    write_atomic(folder / CONFIG, config)
    write_atomic(folder / WEIGHTS, weights)
    return hashlib.sha256(weights).hexdigest()


def is_bundle(folder: Path) -> bool:
    """Whether a folder holds an agent to share; a run folder is none."""
    return (folder / WEIGHTS).is_file() and (folder / CONFIG).is_file()


def load_bundle(folder: Path, sha256: str | None = None) -> Checkpoint:
    """Load an agent that was shared.

    Args:
        folder: with both files.
        sha256: what the hash of ``model.safetensors`` has to be; checked before anything of either
            file is read as what it claims to be.

    Raises:
        ValueError: ``sha256`` is no hash.
        CheckpointError: a file is missing, too large, damaged or another, or of another format.
    """
    if sha256 is not None:
        check_hash(sha256)
    weights = _read(folder, WEIGHTS)
    measured = hashlib.sha256(weights).hexdigest()
    if sha256 is not None and measured != sha256.lower():
        raise CheckpointError(
            f"{folder / WEIGHTS} has the SHA-256 {measured}, not {sha256}: it is another file than "
            "the one you know; nothing of it was read"
        )
    config = _read(folder, CONFIG)
    try:
        tensors = load(weights)
        header = _header(weights)
    except Exception as error:  # safetensors names damage in many ways
        raise CheckpointError(
            f"{folder / WEIGHTS} cannot be read ({type(error).__name__}: {error})"[:300]
        ) from error
    if header.get("config_sha256") != hashlib.sha256(config).hexdigest():
        raise CheckpointError(
            f"{folder / CONFIG} is not the one that {WEIGHTS} was saved with: take both files from "
            "one place, unchanged"
        )
    if header.get("stored_as") == "float16":
        for name, value in tensors.items():
            tensors[name] = value.float() if value.dtype == torch.float16 else value
    settings, frames = _settings(folder / CONFIG, config)
    return Checkpoint(settings, frames, tensors, None, folder)


def check_hash(sha256: str) -> None:
    """Refuse what is no SHA-256 by a ``ValueError``."""
    is_hash = isinstance(sha256, str) and _HASH.fullmatch(sha256.lower()) is not None
    require(is_hash, "sha256", sha256, "64 hexadecimal digits")


def find_checkpoint(path: Path) -> Checkpoint:
    """The weights of one checkpoint, of a run or its ``checkpoints`` folder (the newest that is
    whole), or of a folder with an agent that was shared.
    """
    hint = "give a run folder, one of its checkpoints, or an agent that was shared"
    try:
        names = os.listdir(path)
    # the last for names that no file can have
    except (FileNotFoundError, NotADirectoryError, ValueError) as error:
        raise CheckpointError(f"{no_folder(path)}; {hint}") from error
    except OSError as error:
        raise CheckpointError(f"{path} cannot be looked at: {error.strerror}") from error
    if _META in names:
        return load_checkpoint(path, weights_only=True)
    for folder in (path / "checkpoints", path):
        if list_checkpoints(folder):
            return load_latest(folder, weights_only=True)
    if WEIGHTS in names:
        return load_bundle(path)
    raise CheckpointError(f"{path} holds no checkpoint; {hint}")


def _read(folder: Path, name: str) -> bytes:
    """A file of the folder, if it is a regular one of a size that can be meant."""
    try:
        return read_bytes(folder / name, MOST_BYTES[name])
    except FileNotFoundError as error:
        raise CheckpointError(f"{folder} is no agent to load: {name} is missing") from error
    except OSError as error:
        raise CheckpointError(f"{folder / name} may not be read: {error.strerror}") from error
    except ValueError as error:
        raise CheckpointError(str(error)) from error


def _header(weights: bytes) -> dict[str, str]:
    """What stands in the header of a safetensors file beside its tensors; the file is sound."""
    end = _LENGTH_BYTES + int.from_bytes(weights[:_LENGTH_BYTES], "little")
    header: Any = json.loads(weights[_LENGTH_BYTES:end])
    return dict(header.get("__metadata__", {}))


def _in_one_order(weights: bytes) -> bytes:
    """A safetensors file whose header names its own entries in the order of the alphabet, so that
    equal agents are equal files; ``save`` writes them in any order.
    """
    end = _LENGTH_BYTES + int.from_bytes(weights[:_LENGTH_BYTES], "little")
    header: Any = json.loads(weights[_LENGTH_BYTES:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _LENGTH_BYTES)  # tensors begin at a multiple of eight bytes
    return len(text).to_bytes(_LENGTH_BYTES, "little") + text + weights[end:]


def _settings(file: Path, config: bytes) -> tuple[TrainConfig, int]:
    """The settings and the frames of training of an agent."""
    try:
        about: Any = json.loads(config.decode("utf-8"))
        if reason := refuse_format(f"the agent in {file.parent}", about.get("format")):
            raise CheckpointError(reason)
        frames = about["frames"]
        require(type(frames) is int and 0 <= frames < 10**12, "frames", frames, "a count of frames")
        return TrainConfig.from_dict(about["config"]), frames
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file} does not describe an agent: {error}") from error
