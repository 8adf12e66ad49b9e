"""A replay of sequences: whole windows, each written to one file and never changed, so that a
checkpoint only names them.

Every window of the collector becomes one memory-mapped file; what is used stays in memory as long
as the machine has room. The oldest leaves when the capacity is reached, and its file when no kept
checkpoint can need it any more. TorchRL's ``TensorDictReplayBuffer`` stores the same batches, but
writes everything again for every checkpoint.
"""

import tempfile
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save
from tensordict import TensorDict, TensorDictBase

from arcade_torch.agents.checked import coerce, require
from arcade_torch.agents.runs.files import (
    CheckpointError,
    checksum,
    is_our_name,
    is_ours,
    write_atomic,
)
from arcade_torch.agents.torch_settings import device_of
from arcade_torch.envs_jax.validation import plain

_OLD_LISTS = 2  # lists of segments kept for the checkpoints before the newest


@dataclass
class _Segment:
    """One window: a file, and its tensors [n], mapped, by the text of their key."""

    file: Path
    data: TensorDict
    checksum: str | None = None


def _layout(window: Any) -> dict[str, tuple[torch.dtype, torch.Size]]:
    """Types and sizes of what the sequences of a window hold."""
    return {key: (value.dtype, value.shape[1:]) for key, value in window.items()}


class SequenceReplay:
    """Draws sequences uniformly, in the form in which they were added.

    Args:
        capacity: most sequences to keep, at least 1 (else ValueError); old windows leave whole, the
            newest stays.
        folder: where windows are written, made when first needed; None for a temporary folder.
    """

    def __init__(self, capacity: int, folder: str | Path | None = None) -> None:
        self.capacity = coerce("capacity", plain(capacity), int)
        require(self.capacity >= 1, "capacity", capacity, "at least 1 sequence")
        self._temporary = tempfile.TemporaryDirectory() if folder is None else None
        self._folder = Path(folder or self._temporary.name)  # type: ignore[union-attr]
        self._segments: deque[_Segment] = deque()
        self._added = 0
        self._lists: deque[set[str]] = deque(maxlen=_OLD_LISTS)

    def __len__(self) -> int:
        """Sequences at hand."""
        return sum(len(segment.data) for segment in self._segments)

    @property
    def frames(self) -> int:
        """Frames at hand, without final frames."""
        return sum(segment.data["pixels"].shape[:2].numel() for segment in self._segments)

    def add(self, batch: TensorDictBase) -> None:
        """Store a window of sequences [n], tensors only; everything is copied.

        Raises:
            CheckpointError: the frames at hand, of a run that goes on, have another size.
        """
        flat = batch.flatten_keys("/")
        tensors = {
            key: value.detach().to("cpu", copy=True).contiguous() for key, value in flat.items()
        }
        size = tensors["pixels"].shape[2:]
        held = self._segments[-1].data["pixels"].shape[2:] if self._segments else size
        if held != size:
            raise CheckpointError(
                f"the replay in {self._folder} holds frames {tuple(held)}, the network now stores "
                f"{tuple(size)}: train again, or go on with the version that began the run"
            )
        file = self._folder / f"window-{self._added:09d}.safetensors"
        write_atomic(file, save(tensors))
        self._open(file)
        self._added += 1
        while len(self) > self.capacity and len(self._segments) > 1:
            gone = self._segments.popleft().file
            if gone.name not in set().union(*self._lists):
                gone.unlink(missing_ok=True)

    def _open(self, file: Path, digest: str | None = None) -> None:
        tensors = load_file(file)
        if self._segments and _layout(tensors) != _layout(self._segments[-1].data):
            raise CheckpointError(f"{file} holds other frames than the windows before it")
        self._segments.append(_Segment(file, TensorDict(tensors, [len(tensors["pixels"])]), digest))

    def sample(
        self, count: int, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> TensorDict:
        """Draw sequences uniformly, each at most once.

        Args:
            count: B, from 1 to the number at hand (else ValueError).
            generator: CPU generator of the draw.
            device: where to put them.

        Returns:
            Sequences [B], in the order of age.
        """
        count = coerce("count", plain(count), int)
        device = device_of(device)
        held = len(self)
        require(1 <= count <= held, "count", count, f"from 1 to the {held} sequences at hand")
        drawn_rows = torch.zeros(held, dtype=torch.bool, device="cpu")
        drawn_rows[torch.randperm(held, device="cpu", generator=generator)[:count]] = True
        rows_of = drawn_rows.split([len(segment.data) for segment in self._segments])
        parts = [segment.data[rows] for segment, rows in zip(self._segments, rows_of, strict=True)]
        return TensorDict.cat(parts).to(device).unflatten_keys("/")

    def state_dict(self) -> dict[str, Any]:
        """Name everything at hand, with checksums; call it when a checkpoint is made.

        Files that neither this checkpoint nor the two before it name are removed.
        """
        for segment in self._segments:
            segment.checksum = segment.checksum or checksum(segment.file)
        names = {segment.file.name: segment.checksum for segment in self._segments}
        needed = set(names).union(*self._lists)
        for file in self._folder.glob("window-*"):
            if is_ours(file, "window") and file.name not in needed:
                file.unlink()
        self._lists.append(set(names))
        return {"files": names, "added": self._added}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go back to a saved moment; a ``CheckpointError`` if a file is missing or damaged."""
        if not isinstance(state, Mapping) or not isinstance(state.get("files"), Mapping):
            raise CheckpointError("the checkpoint does not name the windows of a replay")
        added = state["added"]
        require(type(added) is int and 0 <= added < 10**12, "added", added, "a count")
        self._added = added
        self._segments.clear()
        for name, digest in state["files"].items():
            if not is_our_name(name, "window"):
                raise CheckpointError(
                    f"the checkpoint names {name!r}, which is no window of a replay"
                )
            file = self._folder / name
            if not is_ours(file, "window"):
                raise CheckpointError(
                    f"{file} is missing: the replay of this checkpoint is not whole"
                )
            if checksum(file) != digest:
                raise CheckpointError(
                    f"{file} is damaged: it does not have the checksum in the checkpoint"
                )
            self._open(file, digest)
        self._lists = deque([set(state["files"])], maxlen=_OLD_LISTS)
