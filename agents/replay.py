"""A replay of sequences: whole windows, each stored once and never changed, so that a checkpoint only names them.

Every window of the collector becomes one *segment*. Segments are kept in memory, or memory-mapped from their files when
the replay may grow large; either way each is written to a file once. The oldest leaves when the capacity is reached.
A file goes away when no kept checkpoint can need it any more.
"""

import os
import tempfile
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from tensordict import NonTensorData, TensorDict, TensorDictBase
from torch import Tensor

from arcade_torch.agents.checkpoint import CheckpointError
from arcade_torch.agents.files import checksum
from arcade_torch.agents.window import Key, WindowKeys
from arcade_torch.frames import FramePool

_KEYS = WindowKeys()
_ENTRIES: tuple[Key, ...] = (
    _KEYS.pixels,
    _KEYS.action,
    _KEYS.last_action,
    _KEYS.is_init,
    _KEYS.reward,
    _KEYS.terminated,
    _KEYS.truncated,
    _KEYS.frame_slot,
)
_STATE, _POOL, _EXTRA = "state:", "pool", "extra:"
_OLD_LISTS = 2  # lists of segments kept for the checkpoints before the newest


@dataclass(frozen=True)
class _Segment:
    """One window: tensors [n, ...] by name, and the pool of frames [m, ...]."""

    name: str
    tensors: dict[str, Tensor]
    count: int
    checksum: str | None = None


class SequenceReplay:
    """Draws sequences uniformly, in the form ``ArcadeCollector.collect()`` gives them.

    Args:
        capacity: most sequences to keep; whole segments are dropped to stay within.
        folder: where segments are written, made when first needed; None for a temporary folder.
        ram: bytes; a replay that would be larger when full is kept in memory-mapped files only.

    Raises:
        ValueError: ``capacity`` is not positive.
    """

    def __init__(self, capacity: int, folder: Path | None = None, ram: int = 2_000_000_000) -> None:
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1 sequence, got {capacity}")
        self.capacity, self.ram, self.mapped = capacity, ram, False
        self._temporary = None if folder is not None else tempfile.TemporaryDirectory()
        self._folder = folder if folder is not None else Path(self._temporary.name)  # type: ignore[union-attr]
        self._segments: deque[_Segment] = deque()
        self._added = 0
        self._lists: deque[set[str]] = deque(maxlen=_OLD_LISTS)

    def __len__(self) -> int:
        """Sequences at hand."""
        return sum(segment.count for segment in self._segments)

    @property
    def frames(self) -> int:
        """Frames at hand, without final frames."""
        key = _text(_KEYS.pixels)
        return sum(segment.tensors[key].shape[:2].numel() for segment in self._segments)

    @property
    def bytes(self) -> int:
        """Bytes of everything at hand, in memory or in mapped files."""
        return sum(_size(segment.tensors) for segment in self._segments)

    def add(self, batch: TensorDictBase, **extras: Tensor) -> None:
        """Store a window; everything is copied.

        Args:
            batch: sequences [n] of ``ArcadeCollector.collect()``.
            **extras: further entries [n, ...], given back under ``("extras", name)``.

        Raises:
            CheckpointError: the frames at hand, of a run that goes on, have another size.
        """
        size, key = batch.get(_KEYS.pixels).shape[2:], _text(_KEYS.pixels)
        if self._segments and (held := self._segments[-1].tensors[key].shape[2:]) != size:
            raise CheckpointError(
                f"the replay holds frames of {held[0]}x{held[1]} pixels and the encoder now stores "
                f"{size[0]}x{size[1]}: the run began with an earlier version, which can finish it; "
                "or begin it anew in another folder"
            )
        tensors = {_text(key): _own(batch.get(key)) for key in _ENTRIES}
        state = batch.get(_KEYS.initial_state)
        tensors |= {_STATE + _text(key): _own(state.get(key)) for key in state.keys(True, True)}
        tensors |= {_EXTRA + name: _own(value) for name, value in extras.items()}
        tensors[_POOL] = _own(batch[_KEYS.next_pool].pixels)
        segment = _Segment(f"window-{self._added:09d}", tensors, batch.batch_size[0])
        if self._added == 0:
            self.mapped = _size(tensors) / segment.count * self.capacity > self.ram
        self._added += 1
        self._segments.append(self._written(segment) if self.mapped else segment)
        while len(self) > self.capacity and len(self._segments) > 1:
            gone = self._segments.popleft()
            if gone.checksum and gone.name not in set().union(*self._lists):
                self._file(gone.name).unlink(missing_ok=True)

    def sample(self, count: int, generator: torch.Generator, device: torch.device | str = "cpu") -> TensorDict:
        """Draw sequences uniformly, each at most once.

        Args:
            count: B, at most the number at hand.
            generator: CPU generator of the draw.
            device: where to put them.

        Returns:
            Sequences [B] like those of ``ArcadeCollector.collect()``, in the order of age; the recurrent state without
            entries that hold no tensor.

        Raises:
            ValueError: there are fewer.
        """
        held = len(self)
        if not 1 <= count <= held:
            raise ValueError(f"cannot draw {count} of {held} sequences")
        chosen = torch.randperm(held, generator=generator)[:count].sort().values
        first, parts = 0, []
        for segment in self._segments:
            rows = chosen[(chosen >= first) & (chosen < first + segment.count)] - first
            if len(rows):
                parts.append(_rows(segment, rows))
            first += segment.count
        return _sequences(parts, count, device)

    def state_dict(self) -> dict[str, Any]:
        """Write what is not written yet, and name everything at hand; call it when a checkpoint is made.

        Files that neither this checkpoint nor the two before it name are removed.
        """
        self._segments = deque(s if s.checksum else self._written(s) for s in self._segments)
        names = [segment.name for segment in self._segments]
        needed = set(names).union(*self._lists)
        for file in self._folder.glob("window-*"):
            if file.stem not in needed:
                file.unlink()
        self._lists.append(set(names))
        digests = [segment.checksum for segment in self._segments]
        return {"names": names, "checksums": digests, "added": self._added, "mapped": self.mapped}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go back to a saved moment.

        Raises:
            CheckpointError: a file is missing or damaged.
        """
        self._added, self.mapped = state["added"], state["mapped"]
        self._segments = deque(self._read(*item) for item in zip(state["names"], state["checksums"], strict=True))
        self._lists = deque([set(state["names"])], maxlen=_OLD_LISTS)

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.safetensors"

    def _written(self, segment: _Segment) -> _Segment:
        """Write a segment under a temporary name, move it into place, and keep memory or the mapped file."""
        self._folder.mkdir(parents=True, exist_ok=True)
        file = self._file(segment.name)
        temporary = file.with_name(f".{file.name}.{os.getpid()}")
        save_file(segment.tensors, temporary)
        digest = checksum(temporary)
        os.replace(temporary, file)
        tensors = load_file(file) if self.mapped else segment.tensors
        return _Segment(segment.name, tensors, segment.count, digest)

    def _read(self, name: str, digest: str) -> _Segment:
        file = self._file(name)
        if not file.is_file():
            raise CheckpointError(f"{file} is missing: the replay of this checkpoint is not whole")
        if checksum(file) != digest:
            raise CheckpointError(f"{file} is damaged: it does not have the checksum in the checkpoint")
        tensors = load_file(file)  # maps the file
        if not self.mapped:
            tensors = {key: value.clone() for key, value in tensors.items()}
        return _Segment(name, tensors, tensors[_text(_KEYS.pixels)].shape[0], digest)


def _rows(segment: _Segment, rows: Tensor) -> dict[str, Tensor]:
    """Some sequences of a segment, with those frames of its pool that they point to, numbered anew."""
    part = {key: value.index_select(0, rows) for key, value in segment.tensors.items() if key != _POOL}
    slots = part[_text(_KEYS.frame_slot)]
    used = slots >= 0
    part[_POOL] = segment.tensors[_POOL].index_select(0, slots[used])
    slots[used] = torch.arange(part[_POOL].shape[0])
    return part


def _sequences(parts: list[dict[str, Tensor]], count: int, device: torch.device | str) -> TensorDict:
    """Parts of several segments as one batch [count] with one pool."""
    frames = 0
    for part in parts:
        slots = part[_text(_KEYS.frame_slot)]
        slots[slots >= 0] += frames
        frames += part[_POOL].shape[0]
    out, state = TensorDict({}, batch_size=[count]), TensorDict({}, batch_size=[count])
    for name in parts[0]:
        value = torch.cat([part[name] for part in parts]).to(device)
        if name == _POOL:
            pool = FramePool(value.shape[1:], value.shape[0], value.device)
            pool.append(value)
            out[_KEYS.next_pool] = NonTensorData(pool, batch_size=[count])
        elif name.startswith(_STATE):
            state[_key(name.removeprefix(_STATE))] = value
        elif name.startswith(_EXTRA):
            out["extras", name.removeprefix(_EXTRA)] = value
        else:
            out[_key(name)] = value
    out[_KEYS.initial_state] = state
    return out


def _size(tensors: Mapping[str, Tensor]) -> int:
    """Bytes."""
    return sum(x.numel() * x.element_size() for x in tensors.values())


def _own(value: Tensor) -> Tensor:
    """A copy on the CPU that shares nothing."""
    return value.detach().to("cpu", copy=True).contiguous()


def _text(key: Key) -> str:
    return key if isinstance(key, str) else "/".join(key)


def _key(text: str) -> Key:
    parts = tuple(text.split("/"))
    return parts[0] if len(parts) == 1 else parts
