"""Checkpoints: everything a run needs to go on to the bit, in a folder that is either whole or absent.

``checkpoints/`` of a run holds the last two, named by their frame count, and ``latest``, the name of the newest::

    checkpoints/latest                              text: frames-000000204800
    checkpoints/frames-000000204800/weights.safetensors    network, buffers included
    checkpoints/frames-000000204800/trainer.pt             optimiser, counters, generators, environments, memory
    checkpoints/frames-000000204800/meta.json              format, config, frames, checksums; written last

A learner with a replay keeps it beside, in ``replay/`` of the run: the trainer's state names its files.
Nothing is unpickled: weights are safetensors, the rest is loaded with ``weights_only=True``.
"""

import json
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

from arcade_torch.agents.config import TrainConfig, coerce, differing_fields
from arcade_torch.agents.files import checksum as _checksum
from arcade_torch.agents.files import write_atomic
from arcade_torch.agents.plain import from_plain, to_plain

FORMAT = 1
KEEP = 2
_WEIGHTS, _TRAINER, _META, _LATEST = "weights.safetensors", "trainer.pt", "meta.json", "latest"


class CheckpointError(RuntimeError):
    """A checkpoint is missing, damaged, of another format, or of another run."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # names of files may have line breaks


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
        trainer: nested state of tensors, TensorDicts, numbers and text.

    Returns:
        Path of the new checkpoint.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name = f"frames-{frames:012d}"
    temporary = folder / f".{name}.{os.getpid()}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    save_file({key: value.detach().cpu().contiguous().clone() for key, value in weights.items()}, temporary / _WEIGHTS)
    torch.save(to_plain(trainer), temporary / _TRAINER)
    sums = {part: _checksum(temporary / part) for part in (_WEIGHTS, _TRAINER)}
    meta = {"format": FORMAT, "frames": frames, "config": config.to_dict(), "sha256": sums}
    (temporary / _META).write_text(json.dumps(meta, indent=1) + "\n")
    final = folder / name
    if final.exists():
        shutil.rmtree(final)
    os.replace(temporary, final)
    write_atomic(folder / _LATEST, name + "\n")
    for old in list_checkpoints(folder)[KEEP:]:
        shutil.rmtree(old)
    for stale in folder.glob(".frames-*"):
        shutil.rmtree(stale, ignore_errors=True)
    return final


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints in a ``checkpoints/`` folder, the newest (by ``latest``, then by frames) first."""
    found = sorted((p for p in folder.glob("frames-*") if p.is_dir()), reverse=True)
    pointer = folder / _LATEST
    latest = pointer.read_text(encoding="utf-8", errors="replace").strip() if pointer.is_file() else ""
    return sorted(found, key=lambda p: p.name != latest)


def checkpoint_frames(path: Path) -> int:
    """Training frames that a checkpoint was saved at, by the name of its folder; -1 for another name.

    Example:
        >>> checkpoint_frames(Path("run/checkpoints/frames-000000204800"))
        204800
    """
    digits = path.name.removeprefix("frames-")
    return int(digits) if digits.isdecimal() else -1


def discard_later(folder: Path, frames: int) -> None:
    """Remove the checkpoints after ``frames``, of a run that goes on from there; that one becomes the latest.

    Args:
        folder: ``checkpoints/`` of a run.
        frames: of the checkpoint gone on from; 0 for a run that starts over.
    """
    later = [path for path in list_checkpoints(folder) if checkpoint_frames(path) > frames]
    if not later:
        return
    if frames:
        write_atomic(folder / _LATEST, f"frames-{frames:012d}\n")
    else:
        (folder / _LATEST).unlink(missing_ok=True)
    for path in later:
        shutil.rmtree(path)


def load_checkpoint(path: Path, expect: TrainConfig | None = None, weights_only: bool = False) -> Checkpoint:
    """Load one checkpoint folder.

    Args:
        path: folder of the checkpoint.
        expect: config of the run that wants to go on; a checkpoint of another run is refused.
        weights_only: leave the trainer's state on disk.

    Returns:
        The checkpoint.

    Raises:
        CheckpointError: a part is missing or damaged, the format is unknown, or ``expect`` differs.
    """
    meta = _read_meta(path)
    try:
        config = TrainConfig.from_dict(meta["config"])
        frames = coerce("frames", meta["frames"], int)
        sums = dict(meta["sha256"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {_META} does not describe a run ({error})") from error
    if expect is not None and (fields := differing_fields(config, expect)):
        raise CheckpointError(f"checkpoint {path} belongs to another run; differing fields: {', '.join(fields)}")
    for part in (_WEIGHTS,) if weights_only else (_WEIGHTS, _TRAINER):
        if not (path / part).is_file():
            raise CheckpointError(f"checkpoint {path} is damaged: {part} is missing")
        if _checksum(path / part) != sums.get(part):
            raise CheckpointError(f"checkpoint {path} is damaged: {part} does not have the checksum in {_META}")
    try:
        weights = load_file(path / _WEIGHTS)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {_WEIGHTS} holds no tensors ({error})") from error
    trainer = None if weights_only else _load_trainer(path)
    return Checkpoint(config, frames, weights, trainer, path)


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
        CheckpointError: there is none, none is whole, or it belongs to another run.
    """
    candidates = list_checkpoints(folder)
    if not candidates:
        raise CheckpointError(f"no checkpoint in {folder}")
    problems: list[str] = []
    for path in candidates:
        try:
            found = load_checkpoint(path, None, weights_only)
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if expect is not None and (fields := differing_fields(found.config, expect)):
            raise CheckpointError(f"checkpoint {path} belongs to another run; differing fields: {', '.join(fields)}")
        try:
            if use is not None:
                use(found)
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if problems:
            warnings.warn(f"{'; '.join(problems)}; going on from {path.name}", RuntimeWarning, stacklevel=2)
        return found
    raise CheckpointError(f"no whole checkpoint in {folder}: {'; '.join(problems)}")


def _load_trainer(path: Path) -> dict[str, Any]:
    try:
        state: dict[str, Any] = from_plain(torch.load(path / _TRAINER, map_location="cpu", weights_only=True))
    except pickle.UnpicklingError as error:
        raise CheckpointError(f"{_TRAINER} in {path} holds more than tensors, numbers and text; not loaded") from error
    except Exception as error:  # torch and zipfile name damage in many ways
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise CheckpointError(f"{_TRAINER} in {path} is damaged; not loaded ({reason})") from error
    return state


def _read_meta(path: Path) -> dict[str, Any]:
    file = path / _META
    try:
        there = file.is_file()
    except OSError as error:  # a name that is too long, or a folder nobody may enter
        raise CheckpointError(f"{path} cannot be looked at: {error.strerror}") from error
    if not there:
        raise CheckpointError(f"{path} is not a checkpoint: {_META} is missing")
    try:
        meta: Any = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {_META} is not JSON ({error})") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        found = meta.get("format") if isinstance(meta, dict) else None
        raise CheckpointError(f"checkpoint {path} has format {found!r}; this version reads format {FORMAT}")
    return meta
