"""The storage of a collector: one window of L = overlap + T steps, every observation written
once.
"""

import functools
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, cast

import jax
import numpy as np
import torch
from tensordict import NestedKey, TensorDict

from arcade_torch.compiled import (
    EPISODE_REWARD,
    NUM_NUMBERS,
    REWARD,
    STEP_COUNT,
    TERMINATED,
    TRUNCATED,
)
from arcade_torch.dlpack import is_host, upload
from arcade_torch.frame_memory import Canvas, Reused, draws_in_place
from arcade_torch.policies import path_of
from arcade_torch.raw_step import Place
from arcade_torch.suite_actions import as_got

FinalFrames = Literal["all", "truncated", "none"]

_ROOT_COLUMNS: dict[str, torch.dtype] = {
    "is_init": torch.bool,
    "step_count": torch.int64,
    "episode_reward": torch.float32,
}


class Entry(NamedTuple):
    """Shape and type of an entry."""

    shape: tuple[int, ...]  # of one env
    dtype: torch.dtype


def final_key(key: NestedKey) -> NestedKey:
    """The key of final observations in sequences: ``"final_pixels"`` for ``"pixels"``."""
    first, *rest = path_of(key)
    return (f"final_{first}", *rest) if rest else f"final_{first}"


class TensorMemory:
    """Gives tensors, in memory of earlier ones that nobody can see any more; see ``Reused``."""

    def __init__(self, size: tuple[int, ...], entry: Entry, device: torch.device) -> None:
        self._shape = (*size, *entry.shape)
        self._dtype = entry.dtype
        self._device = device
        self._reused = Reused(most=2)  # what is in use, and the one before it
        # under the last tensor, on the CPU: steps may draw into it
        self.canvas: Canvas | None = None

    def take(self) -> torch.Tensor:
        """A tensor of the shape and type, with any content."""
        if not is_host(self._device):  # torch's allocator for GPUs keeps memory by itself
            return torch.empty(self._shape, dtype=self._dtype, device=self._device)
        is_bytes = self._dtype is torch.uint8
        shape = self._shape if is_bytes else (*self._shape, self._dtype.itemsize)
        self.canvas = self._reused.take(functools.partial(Canvas, shape))
        memory = torch.from_numpy(self._reused.hand_out(self.canvas, np.asarray(self.canvas)))
        return memory if is_bytes else memory.view(self._dtype).squeeze(-1)


class RolloutBuffer:
    """The last L steps of N envs, and the observations that follow a step but do not stand at the
    next index.

    With ``final_frames="all"`` the next observations are dense. Otherwise each env has K places for
    them: the last one is for the observation after step L - 1, the others are for the truncations
    before it, in order of time.

    Args:
        num_envs: N.
        overlap: Steps of the previous window that stand in front.
        steps: T, new steps a window.
        observation: The entries of an observation as it is stored, by key.
        action: Shape and type of an action.
        device: Of the storage.
        final_frames: See ``ArcadeCollector``.
        max_steps: The shortest time limit of the games.
        task: int64 [N], the game that each env plays, where there are several.
    """

    def __init__(
        self,
        num_envs: int,
        overlap: int,
        steps: int,
        observation: Mapping[NestedKey, Entry],
        action: Entry,
        device: torch.device,
        final_frames: FinalFrames,
        max_steps: int,
        task: torch.Tensor | None,
    ) -> None:
        self.num_envs = num_envs
        self.overlap = overlap
        self.steps = steps
        self.length = overlap + steps
        self.device = device
        self.final_frames = final_frames
        self._action_entry = action
        # Truncations of an env are max_steps apart: L - 1 steps hold so many at most. The last step
        # has its own place.
        inside = -(-(self.length - 1) // max_steps) if final_frames == "truncated" else 0
        self._places = 1 + inside
        window = (num_envs, self.length)
        places = (num_envs, self._places)
        self._new_observation: dict[NestedKey, TensorMemory] = {}
        self._new_dense: dict[NestedKey, TensorMemory] = {}
        self._new_final: dict[NestedKey, TensorMemory] = {}
        for key, entry in observation.items():
            self._new_observation[key] = TensorMemory(window, entry, device)
            self._new_dense[key] = TensorMemory(window, entry, device)
            self._new_final[key] = TensorMemory(places, entry, device)
        self._extra_entries: dict[NestedKey, Entry] = {}
        self._task = None if task is None else task.unsqueeze(-1).repeat(1, self.length)
        # whose final observation is kept
        self._wanted = np.zeros((num_envs, self.length), np.bool_)
        self._first = 0
        self._fills_dense = False
        # what the next window begins with, apart from bytes: a batch may be written to
        self._kept: dict[NestedKey, torch.Tensor] = {}
        self._kept_final: dict[NestedKey, torch.Tensor] = {}
        self._allocate()

    def _allocate(self) -> None:
        size = (self.num_envs, self.length)
        device = self.device
        self.observation = _taken(self._new_observation)
        shape, dtype = self._action_entry
        self._action = torch.zeros((*size, *shape), dtype=dtype, device=device)
        self._last_action = torch.zeros_like(self._action)
        self._numbers = torch.zeros((*size, NUM_NUMBERS), dtype=torch.int32, device=device)
        self._root = {
            key: torch.zeros(size, dtype=dtype, device=device)
            for key, dtype in _ROOT_COLUMNS.items()
        }
        self._extras = {
            key: torch.zeros((*size, *shape), dtype=dtype, device=device)
            for key, (shape, dtype) in self._extra_entries.items()
        }
        # the observation after every step, made when it is asked for
        self._dense: dict[NestedKey, torch.Tensor] | None = None
        self._final = _taken(self._new_final)
        for places in self._final.values():
            places[:, :-1].zero_()  # the last place is written in every window

    @property
    def done(self) -> torch.Tensor:
        """bool [N, L], where an episode ended."""
        # no list of columns: it is copied to a GPU and waited for
        return self._numbers[..., TERMINATED:].any(-1)

    def begin(self, carry: bool, reuse: bool, dense: bool) -> int:
        """Get ready for a window, and give the index of its first new step.

        Args:
            carry: Move the overlap to the front; otherwise it is filled anew.
            reuse: Write over the storage of the last window.
            dense: Whether the next observations of all steps are wanted.
        """
        carry = carry and self.overlap > 0
        self._first = self.overlap if carry else 0
        before = self._buffers()
        final = self._final | self._kept_final
        wanted = self._wanted
        if not reuse:
            self._allocate()
        self._wanted = np.zeros_like(wanted)
        # also where nobody wants them now: the overlap of the next window begins with them
        self._fills_dense = dense or bool(self.overlap and self.final_frames == "all")
        if self._fills_dense and self._dense is None:
            self._dense = _taken(self._new_dense)
        if carry:
            self._carry_overlap(before, final, wanted)
        return self._first

    def _carry_overlap(
        self,
        before: Mapping[NestedKey, torch.Tensor],
        final: Mapping[NestedKey, torch.Tensor],
        wanted: np.ndarray,
    ) -> None:
        """Put the last steps of the window before in front of this one: its buffers, final
        observations, and whose were wanted.
        """
        for key, target in self._buffers().items():
            if key in self._kept:
                target[:, : self.overlap] = self._kept[key]
                continue
            # Step by step when source and target overlap; upwards, so that nothing is overwritten
            # before it is read.
            portion = self.overlap if self.overlap <= self.steps else 1
            for first in range(0, self.overlap, portion):
                start = first + self.steps
                target[:, first : first + portion] = before[key][:, start : start + portion]
        self._wanted[:, : self.overlap] = wanted[:, self.steps :]
        if self._places > 1:
            rows, steps = np.nonzero(self._wanted)
            now = self._place_of(self._wanted, rows, steps)
            then = self._place_of(wanted, rows, steps + self.steps)
            row = upload(rows, self.device)
            target_place = upload(now, self.device)
            source_place = upload(then, self.device)
            for key, places in self._final.items():
                places[row, target_place] = final[key][row, source_place]

    def place(self, step: int) -> Place | None:
        """Where the ``pixels`` that a step sees may be drawn; None on a GPU, or if the window ends
        before it.
        """
        canvas = self._new_observation["pixels"].canvas
        if canvas is None or step == self.length:
            return None
        config = cast(Any, jax.config)
        if config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs:
            return None
        if not draws_in_place():
            return None
        pixels = self.observation["pixels"]
        if pixels.data_ptr() != canvas.address:  # share_memory_ has moved it
            return None
        return canvas, step, pixels[:, step]

    def write_action(
        self, step: int, obs: Mapping[NestedKey, torch.Tensor], action: torch.Tensor
    ) -> None:
        """Write what was seen and done. Copy what was seen, unless JAX has drawn it into the buffer
        already.
        """
        for key, stored in self.observation.items():
            target = stored[:, step]
            if obs[key].data_ptr() != target.data_ptr():
                target.copy_(obs[key])
            if self._dense is not None and self._fills_dense and step > self._first:
                self._dense[key][:, step - 1].copy_(obs[key])
        _write(self._action, np.s_[:, step], action)

    def write_outcome(self, step: int, numbers: torch.Tensor) -> None:
        """Write what came of it, ``Step.numbers``."""
        _write(self._numbers, np.s_[:, step], numbers)

    def write_extras(self, step: int, extras: Mapping[NestedKey, torch.Tensor]) -> None:
        """Write what the policy wants stored; space is made at the first step."""
        for key, value in extras.items():
            if key not in self._extras:
                self._add_extra(key, Entry(tuple(value.shape[1:]), value.dtype))
            self._extras[key][:, step] = value

    def _add_extra(self, key: NestedKey, entry: Entry) -> None:
        self._extra_entries[key] = entry
        size = (self.num_envs, self.length, *entry.shape)
        self._extras[key] = torch.zeros(size, dtype=entry.dtype, device=self.device)

    def finish(
        self, root: Mapping[NestedKey, torch.Tensor], last: Mapping[NestedKey, torch.Tensor]
    ) -> np.ndarray:
        """Work out what each step began with. The host waits here, once a window.

        Args:
            root: What the first new step began with: last_action [N, ...], is_init, step_count,
                episode_reward [N, 1].
            last: The observation that follows the last step, [N, ...] by key.

        Returns:
            bool [N, L], the new steps whose final observations are to be drawn; see
            ``write_final``.

        Raises:
            RuntimeError: A game truncated earlier than at its time limit.
        """
        self._write_roots(root)
        for key, value in last.items():
            self._final[key][:, -1] = value
            if self._dense is not None and self._fills_dense:
                self._dense[key][:, -1] = value
        if self.final_frames == "none" or (self.final_frames == "all" and not self._fills_dense):
            return np.zeros_like(self._wanted)
        self._mark_wanted()
        new = self._wanted.copy()
        new[:, : self._first] = False
        return new

    def _write_roots(self, root: Mapping[NestedKey, torch.Tensor]) -> None:
        """Write what the new steps began with: the first one with ``root``, each other one with the
        outcome of the step before it.
        """
        first = self._first
        for key, column in self._root.items():
            column[:, first] = root[key].reshape(self.num_envs)
        self._last_action[:, first] = root["last_action"]
        before = slice(first, self.length - 1)
        after = slice(first + 1, self.length)
        done = self.done[:, before]
        numbers = self._numbers[:, before]
        self._last_action[:, after] = as_got(self._action[:, before])
        self._root["is_init"][:, after] = done
        step_count = numbers[..., STEP_COUNT].to(torch.int64)
        self._root["step_count"][:, after] = step_count.masked_fill(done, 0)
        episode_reward = numbers[..., EPISODE_REWARD].view(torch.float32)
        self._root["episode_reward"][:, after] = episode_reward.masked_fill(done, 0)

    def _mark_wanted(self) -> None:
        """Mark the new steps whose final observations are kept; the host waits for the flags."""
        first = self._first
        flags = (self._numbers[:, first:, TERMINATED:] > 0).cpu().numpy()
        terminated = flags[..., 0]
        truncated = flags[..., 1]
        if self.final_frames == "all":
            self._wanted[:, first:] = terminated | truncated
        else:
            self._wanted[:, first:] = truncated & ~terminated
        if self._places > 1 and self._wanted[:, :-1].sum(1).max() >= self._places:
            raise RuntimeError(
                "a game truncated an episode before its max_steps: collect with final_frames='all'"
            )

    def keep_overlap(self) -> None:
        """Copy what the next window begins with, before somebody gets the batch; not bytes, of
        which there are too many.
        """
        self._kept.clear()
        self._kept_final.clear()
        if not self.overlap:
            return
        for key, buffer in self._buffers().items():
            if buffer.dtype is not torch.uint8:
                self._kept[key] = buffer[:, self.steps :].clone()
        for key, places in self._final.items():
            if places.dtype is not torch.uint8:
                self._kept_final[key] = places.clone()

    def write_final(
        self, rows: np.ndarray, steps: np.ndarray, obs: Mapping[NestedKey, torch.Tensor]
    ) -> None:
        """Write what really followed steps (int64 [n]) of envs (``rows`` int64 [n]): [n, ...] by
        key.
        """
        places = self._place_of(self._wanted, rows, steps)
        for key, value in obs.items():
            if self._dense is not None:  # as one axis: a frame is copied whole, not byte by byte
                _write(self._dense[key].flatten(0, 1), rows * self.length + steps, value)
            if self.final_frames == "truncated":
                _write(self._final[key].flatten(0, 1), rows * self._places + places, value)

    def _place_of(self, wanted: np.ndarray, rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """The places of the final observations of some envs and steps."""
        earlier = (np.cumsum(wanted, 1) - wanted)[rows, steps]
        return np.where(steps == self.length - 1, self._places - 1, earlier)

    def sequences(self, initial_state: TensorDict) -> TensorDict:
        """Everything as TensorDict [N] of entries [N, L, ...]; frames and extras are views of the
        storage.
        """
        out = self._entries(0, [self.num_envs])
        out["initial_state"] = initial_state
        if self.final_frames == "all":
            assert self._dense is not None
            for key, dense in self._dense.items():
                out["next", *path_of(key)] = dense
            return out
        index = np.full((self.num_envs, self._places), self.length - 1)
        mask = np.zeros((self.num_envs, self._places), np.bool_)
        rows, steps = np.nonzero(self._wanted[:, :-1])
        place = self._place_of(self._wanted, rows, steps)
        index[rows, place] = steps
        mask[rows, place] = True
        used = upload(mask, self.device)
        if self.final_frames == "truncated":
            used[:, -1] = self._numbers[:, -1, TERMINATED] == 0
        else:
            used[:, -1] = ~self.done[:, -1]
        for key, places in self._final.items():
            out[final_key(key)] = places
        out["final_mask"] = used
        out["final_index"] = upload(index, self.device)
        return out

    def transitions(self, compact: bool) -> TensorDict:
        """The T new steps as TensorDict [N, T] in TorchRL's layout; without the observations in
        ``"next"`` if ``compact``.
        """
        size = [self.num_envs, self.steps]
        out = self._entries(self.overlap, size)
        for key in ("done", "terminated", "truncated", ("next", "is_init")):
            out[key] = torch.zeros((*size, 1), dtype=torch.bool, device=self.device)
        # copies, for either may be written to
        out["next", "last_action"] = as_got(out["action"]).clone()
        if self._task is not None:
            out["next", "task"] = out["task"].clone()
        if not compact and self._dense is not None:
            for key, dense in self._dense.items():
                out["next", *path_of(key)] = dense[:, self.overlap :]
        out.names = [None, "time"]
        return out

    def _entries(self, first: int, batch_size: list[int]) -> TensorDict:
        """All entries but the observations that follow the steps, from step ``first`` on."""
        numbers = self._numbers[:, first:]
        reward = numbers[..., REWARD, None].view(torch.float32)
        episode_reward = numbers[..., EPISODE_REWARD, None].view(torch.float32)
        out = TensorDict({}, batch_size=batch_size, device=self.device)
        entries: dict[NestedKey, torch.Tensor] = {
            "action": self._action[:, first:],
            "last_action": self._last_action[:, first:],
            "is_init": self._root["is_init"][:, first:, None],
            "step_count": self._root["step_count"][:, first:, None],
            "episode_reward": self._root["episode_reward"][:, first:, None],
            # view and consolidate of a tensordict take no columns
            ("next", "reward"): reward.contiguous(),
            ("next", "episode_reward"): episode_reward.contiguous(),
            ("next", "step_count"): numbers[..., STEP_COUNT, None].to(torch.int64),
            ("next", "terminated"): numbers[..., TERMINATED, None] > 0,
            ("next", "truncated"): numbers[..., TRUNCATED, None] > 0,
            ("next", "done"): self.done[:, first:, None],
        }
        for key, buffer in (self.observation | self._extras).items():
            entries[key] = buffer[:, first:]
        if self._task is not None:
            entries["task"] = self._task[:, first:].clone()
        for key, value in entries.items():
            out[key] = value
        return out

    def _buffers(self) -> dict[NestedKey, torch.Tensor]:
        """All buffers with axes [N, L, ...]."""
        buffers: dict[NestedKey, torch.Tensor] = {
            "action": self._action,
            "last_action": self._last_action,
            "outcomes": self._numbers,
        }
        buffers.update(self._root)
        for key, stored in self.observation.items():
            buffers["observation", *path_of(key)] = stored
        if self._dense is not None and self.final_frames == "all":
            for key, dense in self._dense.items():
                buffers["dense", *path_of(key)] = dense
        for key, buffer in self._extras.items():
            buffers["extras", *path_of(key)] = buffer
        return buffers

    def _overlap_buffers(self) -> dict[str, torch.Tensor]:
        """The steps of all buffers that the next window begins with, by path; views."""
        buffers = _by_path(self._buffers())
        return {name: buffer[:, self.steps :] for name, buffer in buffers.items()}

    def overlap_state(self) -> dict[str, Any]:
        """What the next window needs of this one, as plain tensors: nothing without an overlap."""
        if not self.overlap:
            return {}
        steps = self._overlap_buffers()
        steps.update(_by_path(self._kept))
        final = _by_path(self._final | self._kept_final, "final")
        return {
            "buffers": {name: value.clone() for name, value in steps.items()},
            "final": {name: value.clone() for name, value in final.items()},
            "wanted": torch.from_numpy(self._wanted).clone(),
        }

    def load_overlap_state(self, state: dict[str, Any]) -> None:
        """Load what ``overlap_state`` gave; raises ValueError if that was a collector with other
        sizes.
        """
        if not state:
            return
        state = _of_today(state)
        self._add_extras_of(state["buffers"])
        if self.final_frames == "all":
            self._dense = _taken(self._new_dense)
        ours = self._overlap_buffers() | _by_path(self._final, "final")
        saved = state["buffers"] | state["final"]
        for name in ours | saved:
            our_shape = tuple(ours[name].shape) if name in ours else None
            saved_shape = tuple(saved[name].shape) if name in saved else None
            if our_shape != saved_shape:
                raise ValueError(
                    f"saved overlap {name!r} is {saved_shape}, this collector's {our_shape}"
                )
            ours[name].copy_(saved[name])
        wanted = state["wanted"].cpu().numpy().copy()
        if (wanted.dtype, wanted.shape) != (self._wanted.dtype, self._wanted.shape):
            raise ValueError(
                f"saved overlap 'wanted' is {wanted.shape}, this collector's {self._wanted.shape}"
            )
        self._wanted = wanted
        self.keep_overlap()

    def _add_extras_of(self, buffers: Mapping[str, torch.Tensor]) -> None:
        """Make space for what the policy wrote to saved buffers, [N, steps, ...] by path."""
        for name, buffer in buffers.items():
            kind, *path = name.split("/")
            if kind == "extras" and tuple(path) not in map(path_of, self._extras):
                key = tuple(path) if len(path) > 1 else path[0]
                self._add_extra(key, Entry(tuple(buffer.shape[2:]), buffer.dtype))


def _by_path(buffers: Mapping[NestedKey, torch.Tensor], *above: str) -> dict[str, torch.Tensor]:
    """Buffers by their path as one word."""
    return {"/".join((*above, *path_of(key))): buffer for key, buffer in buffers.items()}


def _write(target: torch.Tensor, index: Any, values: torch.Tensor) -> None:
    """Write values (no gradient) to a place; on the CPU through numpy, at a sixth of a tensor's
    price or less.
    """
    if is_host(target.device) and target.dtype is not torch.bfloat16:  # which NumPy lacks
        target.numpy()[index] = values.numpy()
    else:
        target[upload(index, target.device) if isinstance(index, np.ndarray) else index] = values


def _taken(memories: Mapping[NestedKey, TensorMemory]) -> dict[NestedKey, torch.Tensor]:
    """Tensors of all memories."""
    return {key: memory.take() for key, memory in memories.items()}


def _of_today(state: dict[str, Any]) -> dict[str, Any]:
    """An overlap's state in the layout of this version: version 0.2.0 knew frames alone."""
    if isinstance(state["final"], dict):
        return state
    newer = {"pixels": "observation/pixels", "dense": "dense/pixels"}
    buffers = {newer.get(name, name): buffer for name, buffer in state["buffers"].items()}
    return state | {"buffers": buffers, "final": {"final/pixels": state["final"]}}
