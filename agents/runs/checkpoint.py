"""Checkpoints: everything a run needs to go on to the bit, in a folder that is either whole or absent.

``checkpoints/`` of a run holds the last two, named by their frame count, and ``latest``, the name of the newest::

    checkpoints/latest                              text: frames-000000204800
    checkpoints/frames-000000204800/weights.safetensors    network, buffers included
    checkpoints/frames-000000204800/trainer.pt             optimiser, counters, generators, environments, memory
    checkpoints/frames-000000204800/meta.json              format, config, frames, checksums; written last

A learner with a replay keeps it beside, in ``replay/`` of the run: the trainer's state names its files.
Nothing is unpickled: weights are safetensors, the rest is loaded with ``weights_only=True``.
"""

import os
import pickle
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from arcade_torch.agents.config import TrainConfig, differing_fields
from arcade_torch.agents.runs.files import CheckpointError, checksum, read_json, write_atomic, write_json

FORMAT = 2
"""Format of checkpoints and run folders; 1 is that of arcade-torch 0.1, which is refused."""
KEEP = 2
_WEIGHTS, _TRAINER, _META, _LATEST = "weights.safetensors", "trainer.pt", "meta.json", "latest"


class _OtherRunError(CheckpointError):
    """The checkpoint is whole but cannot be used here, nor can those before it."""


@dataclass(frozen=True)
class Checkpoint:
    """One loaded checkpoint.

    Attributes:
        config: of the run it belongs to.
        frames: training frames it was saved at.
        weights: the network's ``state_dict``, on the CPU.
        trainer: the rest of the training state; None if only the weights were asked for.
        path: its folder.
    """

    config: TrainConfig
    frames: int
    weights: dict[str, Tensor]
    trainer: dict[str, Any] | None
    path: Path


def save_checkpoint(
    folder: Path, config: TrainConfig, frames: int, weights: dict[str, Tensor], trainer: dict[str, Any]
) -> Path:
    """Write a checkpoint and make it the latest; keep the last two.

    The folder is written under a temporary name and renamed, then ``latest`` is replaced: a process killed at any
    moment leaves at least the previous checkpoint whole.

    Args:
        folder: ``checkpoints/`` of a run.
        config: of the run.
        frames: training frames so far.
        weights: the network's ``state_dict``.
        trainer: nested state of tensors, numbers, text, dictionaries and lists.

    Returns:
        Path of the new checkpoint.
    """
    final = folder / f"frames-{frames:012d}"
    draft = folder / f".{final.name}.{os.getpid()}"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    save_file({key: value.detach().cpu().contiguous().clone() for key, value in weights.items()}, draft / _WEIGHTS)
    torch.save(trainer, draft / _TRAINER)
    sums = {part: checksum(draft / part) for part in (_WEIGHTS, _TRAINER)}
    write_json(draft / _META, {"format": FORMAT, "frames": frames, "config": config.to_dict(), "sha256": sums})
    if final.exists():
        shutil.rmtree(final)
    os.replace(draft, final)
    write_atomic(folder / _LATEST, final.name + "\n")
    for old in (*list_checkpoints(folder)[KEEP:], *folder.glob(".frames-*")):
        shutil.rmtree(old, ignore_errors=True)
    return final


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints in a ``checkpoints/`` folder, the newest (by ``latest``, then by frames) first."""
    found = sorted((path for path in folder.glob("frames-*") if path.is_dir()), reverse=True)
    pointer = folder / _LATEST
    latest = pointer.read_text(encoding="utf-8", errors="replace").strip() if pointer.is_file() else ""
    return sorted(found, key=lambda path: path.name != latest)


def load_checkpoint(path: Path, expect: TrainConfig | None = None, weights_only: bool = False) -> Checkpoint:
    """Load one checkpoint folder.

    Args:
        path: folder of the checkpoint.
        expect: config of the run that wants to go on; a checkpoint of another run is refused.
        weights_only: leave the trainer's state on disk.

    Returns:
        The checkpoint.

    Raises:
        CheckpointError: a part is missing or damaged, the format is another, or ``expect`` differs.
    """
    meta = _read_meta(path)
    try:
        config, frames, sums = TrainConfig.from_dict(meta["config"]), meta["frames"], dict(meta["sha256"])
        if not isinstance(frames, int) or isinstance(frames, bool):
            raise ValueError(f"frames must be a whole number; got {frames!r}")
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {_META} does not describe a run ({error})") from error
    for part in (_WEIGHTS,) if weights_only else (_WEIGHTS, _TRAINER):
        if not (path / part).is_file():
            raise CheckpointError(f"checkpoint {path} is damaged: {part} is missing")
        if checksum(path / part) != sums.get(part):
            raise CheckpointError(f"checkpoint {path} is damaged: {part} does not have the checksum in {_META}")
    try:
        weights = load_file(path / _WEIGHTS)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {_WEIGHTS} holds no tensors ({error})") from error
    if expect is not None and (fields := differing_fields(config, expect)):
        raise _OtherRunError(f"checkpoint {path} belongs to another run; differing fields: {', '.join(fields)}")
    return Checkpoint(config, frames, weights, None if weights_only else _load_trainer(path), path)


def load_latest(
    folder: Path,
    expect: TrainConfig | None = None,
    weights_only: bool = False,
    use: Callable[[Checkpoint], None] | None = None,
) -> Checkpoint:
    """Load the newest checkpoint that is whole, falling back to the one before it with a warning.

    Args:
        folder: ``checkpoints/`` of a run.
        expect: see :func:`load_checkpoint`; a checkpoint of another run is an error, never skipped.
        weights_only: see :func:`load_checkpoint`.
        use: called with the checkpoint; one for which it raises ``CheckpointError`` counts as damaged.

    Returns:
        The checkpoint.

    Raises:
        CheckpointError: there is none, none is whole, or it belongs to another run or to version 0.1.
    """
    problems: list[str] = []
    for path in list_checkpoints(folder):
        try:
            found = load_checkpoint(path, expect, weights_only)
            if use is not None:
                use(found)
        except _OtherRunError:
            raise
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if problems:
            warnings.warn(f"{'; '.join(problems)}; going on from {path.name}", RuntimeWarning, stacklevel=2)
        return found
    raise CheckpointError(
        f"no whole checkpoint in {folder}: {'; '.join(problems)}" if problems else f"no checkpoint in {folder}"
    )


def refuse_format(what: object, found: Any) -> str | None:
    """Why a checkpoint or run folder of a format is refused, in one line; None if it is ours."""
    if found == FORMAT:
        return None
    origin = "was made by arcade-torch 0.1" if found == 1 else f"has format {found!r}"
    return f"{what} {origin}; this version reads format {FORMAT}: train it again, or use the version that made it"


def _read_meta(path: Path) -> dict[str, Any]:
    file = path / _META
    try:
        there = file.is_file()
    except OSError as error:  # a name that is too long, or a folder nobody may enter
        raise CheckpointError(f"{path} cannot be looked at: {error.strerror}") from error
    if not there:
        raise CheckpointError(f"{path} is not a checkpoint: {_META} is missing")
    try:
        meta: Any = read_json(file)
    except ValueError as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {_META} is not JSON ({error})") from error
    if not isinstance(meta, dict):
        raise CheckpointError(f"checkpoint {path} is damaged: {_META} holds no table")
    if reason := refuse_format(f"checkpoint {path}", meta.get("format")):
        raise _OtherRunError(reason)
    return meta


def _load_trainer(path: Path) -> dict[str, Any]:
    try:
        state: dict[str, Any] = torch.load(path / _TRAINER, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(f"{_TRAINER} in {path} holds more than tensors, numbers and text; not loaded") from error
    except Exception as error:  # torch and zipfile name damage in many ways
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise CheckpointError(f"{_TRAINER} in {path} is damaged; not loaded ({reason})") from error
    return state
