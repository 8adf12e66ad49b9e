"""Checkpoints: everything a run needs to go on to the bit, in a folder that is either whole or
absent.

``checkpoints/`` of a run holds the last two, named by their frame count, and ``latest``, the name
of the newest::

    checkpoints/latest                       text: frames-000000204800
    checkpoints/frames-000000204800/
        weights.safetensors                  network that acts, with buffers
        trainer.pt                           optimiser, counters, generators, environments, memory
        meta.json                            format, config, frames, checksums; written last

A learner with a replay keeps it beside, in ``replay/`` of the run: the trainer's state names its
files. Nothing is unpickled: weights are safetensors, the rest is loaded with ``weights_only=True``.
"""

import io
import os
import pickle
import pickletools
import re
import shutil
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import differing_fields
from arcade_torch.agents.runs.files import (
    LATEST,
    MOST_JSON,
    MOST_TENSORS,
    CheckpointError,
    checksum,
    is_ours,
    latest_name,
    list_checkpoints,
    open_regular,
    read_bytes,
    read_json,
    write_atomic,
    write_json,
)

FORMAT = 2
"""Format of checkpoints and run folders; 1 is that of arcade-torch 0.1, which is refused."""
KEEP = 2
MOST_WEIGHTS = 2 * 2**30
"""Bytes of the largest weights that are read."""
_PLAIN = re.compile(
    r"torch\._utils _rebuild_(tensor_v2|parameter)|torch \w+Storage|collections OrderedDict"
    r"|torch (Size|device|u?int\d+|b?float\d+|bool)"
)
"""What ``torch.save`` names in tables of tensors, numbers and text."""
_WEIGHTS = "weights.safetensors"
_TRAINER = "trainer.pt"
_META = "meta.json"

_MOST_BYTES = {_WEIGHTS: MOST_WEIGHTS, _TRAINER: MOST_TENSORS}


class _OtherRunError(CheckpointError):
    """The checkpoint is whole but cannot be used here, nor can those before it."""


@dataclass(frozen=True)
class Checkpoint:
    """One loaded checkpoint, of the folder ``path``."""

    config: TrainConfig
    frames: int
    weights: dict[str, Tensor]  # the network's state_dict, on the CPU
    # the rest of the training state; None if only the weights were asked for
    trainer: dict[str, Any] | None
    path: Path


def save_checkpoint(
    folder: Path,
    config: TrainConfig,
    frames: int,
    weights: dict[str, Tensor],
    trainer: dict[str, Any],
) -> Path:
    """Write a checkpoint and make it the latest; keep the last two.

    The folder is written under a temporary name and renamed, then ``latest`` is replaced: a process
    killed at any moment leaves at least the previous checkpoint whole.

    The weights are the network's ``state_dict``, the trainer's state nests tensors, numbers, text,
    dicts and lists.
    """
    final = folder / f"frames-{frames:012d}"
    draft = folder / f".{final.name}.{os.getpid()}"
    shutil.rmtree(draft, ignore_errors=True)
    try:
        _write_parts(draft, config, frames, weights, trainer)
        if final.is_symlink():
            final.unlink()
        shutil.rmtree(final, ignore_errors=True)
        os.replace(draft, final)
    except BaseException:  # a full disk, for one: what is half written makes room
        shutil.rmtree(draft, ignore_errors=True)
        raise
    write_atomic(folder / LATEST, final.name + "\n")
    for old in list_checkpoints(folder)[KEEP:]:
        shutil.rmtree(old, ignore_errors=True)
    remove_draft_checkpoints(folder)
    return final


def _write_parts(
    draft: Path,
    config: TrainConfig,
    frames: int,
    weights: dict[str, Tensor],
    trainer: dict[str, Any],
) -> None:
    """Write the files of a checkpoint into a folder that is made."""
    draft.mkdir(parents=True)
    tensors = {key: value.detach().cpu().contiguous().clone() for key, value in weights.items()}
    packed = save(tensors)
    if len(packed) > MOST_WEIGHTS:
        raise CheckpointError(
            f"the weights take {len(packed):,} bytes, at most {MOST_WEIGHTS:,}: use a smaller "
            "network"
        )
    write_atomic(draft / _WEIGHTS, packed)
    state = io.BytesIO()
    torch.save(trainer, state)
    write_atomic(draft / _TRAINER, state.getvalue())
    sums = {part: checksum(draft / part) for part in (_WEIGHTS, _TRAINER)}
    write_json(
        draft / _META,
        {"format": FORMAT, "frames": frames, "config": config.to_dict(), "sha256": sums},
    )


def remove_draft_checkpoints(folder: Path) -> None:
    """Remove what a killed process left of a checkpoint, and nothing else."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if is_ours(path, "checkpoint draft"):
            shutil.rmtree(path, ignore_errors=True)


def load_checkpoint(
    path: Path, expect: TrainConfig | None = None, weights_only: bool = False
) -> Checkpoint:
    """Load one checkpoint folder; with ``weights_only`` the trainer's state is left on disk.

    Raises:
        CheckpointError: a part is missing or damaged, the format is another, or the config is not
            ``expect``.
    """
    meta = _read_meta(path)
    try:
        config = TrainConfig.from_dict(meta["config"])
        frames = meta["frames"]
        sums = dict(meta["sha256"])
        require(type(frames) is int and 0 <= frames < 10**12, "frames", frames, "a count of frames")
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} is damaged: {_META} does not describe a run ({error})"
        ) from error
    weights = _read_part(path / _WEIGHTS, sums, _load_weights)
    fields = [] if expect is None else differing_fields(config, expect)
    if fields:
        raise _OtherRunError(
            f"checkpoint {path} belongs to another run; differing fields: {', '.join(fields)}"
        )
    trainer = None if weights_only else _read_part(path / _TRAINER, sums, _load_tensors)
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
        expect: config of the run that wants to go on; a checkpoint of another run is an error,
            never skipped.
        weights_only: leave the trainer's state on disk.
        use: called with the checkpoint; one for which it raises ``CheckpointError`` counts as
            damaged.

    Raises:
        CheckpointError: there is none, none is whole, or it belongs to another run or to version
            0.1.
    """
    problems: list[str] = []
    latest = latest_name(folder)
    if latest and not os.path.lexists(folder / latest):  # a copy that was not finished, for one
        problems.append(f"{folder / latest}, the newest by its name in {LATEST}, is missing")
    for path in list_checkpoints(folder):
        try:
            checkpoint = load_checkpoint(path, expect, weights_only)
            if use is not None:
                use(checkpoint)
        except _OtherRunError:
            raise
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if problems:
            warnings.warn(
                f"{'; '.join(problems)}; going on from {path.name}", RuntimeWarning, stacklevel=2
            )
        return checkpoint
    if problems:
        raise CheckpointError(f"no whole checkpoint in {folder}: {'; '.join(problems)}")
    raise CheckpointError(f"no checkpoint in {folder}")


def refuse_format(subject: str, saved: Any) -> str | None:
    """Why a checkpoint or run folder of a format is refused, in one line; None if it is ours."""
    if saved == FORMAT:
        return None
    origin = "was made by arcade-torch 0.1" if saved == 1 else f"has format {saved!r}"
    return (
        f"{subject} {origin}; this version reads format {FORMAT}: train it again, or use the "
        "version that made it"
    )


def _load_weights(file: Path) -> dict[str, Tensor]:
    return load(read_bytes(file, MOST_WEIGHTS))


def _load_tensors(file: Path) -> dict[str, Any]:
    """What ``torch.save`` wrote, if it takes no more memory than the file has bytes."""
    with open_regular(file, MOST_TENSORS) as stream:
        with zipfile.ZipFile(stream) as archive:
            _check_archive(archive)
        stream.seek(0)
        state: Any = torch.load(stream, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise ValueError("it holds no table of names and values")
        return state


def _check_archive(archive: zipfile.ZipFile) -> None:
    """Refuse parts that are packed, and tables that call for anything but tensors: both may grow
    without bound.
    """
    for entry in archive.infolist():
        if entry.compress_type != zipfile.ZIP_STORED:
            raise ValueError(f"{entry.filename} is compressed, which torch.save does not do")
        if not entry.filename.endswith(".pkl"):
            continue
        if entry.file_size > MOST_JSON:
            raise ValueError(
                f"{entry.filename} has {entry.file_size:,} bytes, at most {MOST_JSON:,} are read"
            )
        for operation, argument, _ in pickletools.genops(archive.read(entry)):
            called = operation.name in ("GLOBAL", "INST", "STACK_GLOBAL")
            if called and not _PLAIN.fullmatch(str(argument)):
                raise ValueError(f"it names {argument}, which is no part of a trainer's state")


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        meta: Any = read_json(path / _META)
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} is not a checkpoint: {_META} is missing") from error
    except OSError as error:
        raise CheckpointError(f"{path} cannot be looked at: {error.strerror}") from error
    except ValueError as error:
        raise CheckpointError(
            f"checkpoint {path} is damaged: {_META} is not JSON ({error})"
        ) from error
    if not isinstance(meta, dict):
        raise CheckpointError(f"checkpoint {path} is damaged: {_META} holds no table")
    if reason := refuse_format(f"checkpoint {path}", meta.get("format")):
        raise _OtherRunError(reason)
    return meta


def _read_part(
    file: Path, sums: dict[str, str], read: Callable[[Path], dict[str, Any]]
) -> dict[str, Any]:
    """What a part of a checkpoint holds, if it is the one that was saved."""
    try:
        if checksum(file, _MOST_BYTES[file.name]) == sums.get(file.name):
            return read(file)
        damage = f"does not have the checksum in {_META}"
    except FileNotFoundError:
        damage = "is missing"
    except PermissionError as error:
        raise CheckpointError(f"{file} may not be read: {error.strerror}") from error
    except pickle.UnpicklingError:
        damage = "holds more than tensors, numbers and text; not loaded"
    except Exception as error:  # torch, zipfile and safetensors name damage in many ways
        damage = f"cannot be read ({type(error).__name__}: {error})"[:300]
    raise CheckpointError(f"checkpoint {file.parent} is damaged: {file.name} {damage}")
