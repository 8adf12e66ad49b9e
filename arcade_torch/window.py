"""The storage of a collector: one window of L = context + T steps, allocated once, every frame written once."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import torch
from tensordict import NestedKey, NonTensorData, TensorDict

from arcade_torch.compiled import EPISODE_REWARD, NUM_NUMBERS, REWARD, STEP_COUNT, TERMINATED, TRUNCATED
from arcade_torch.dlpack import to_torch
from arcade_torch.frames import FramePool

_ROOT_COLUMNS: dict[str, torch.dtype] = {
    "last_action": torch.int64,
    "is_init": torch.bool,
    "step_count": torch.int64,
    "episode_reward": torch.float32,
}


class Rows:
    """Numbers of every env and step, [N, L, ...], written step by step.

    On the CPU through numpy, which costs a sixth of DLPack and a tensor copy.
    """

    def __init__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
        self.tensor = torch.zeros(shape, dtype=dtype, device=device)
        self._numpy = self.tensor.numpy() if device.type == "cpu" else None

    def write(self, step: int, value: jax.Array | torch.Tensor) -> None:
        """Write one step of all envs; ``value`` is [N, ...]."""
        if self._numpy is not None:
            self._numpy[:, step] = np.asarray(value)
        else:
            self.tensor[:, step] = value if isinstance(value, torch.Tensor) else to_torch(value, self.tensor.device)


class Window:
    """The last L steps of N envs, their frames, and the pool of frames that follow no other.

    Args:
        num_envs: N.
        context: Steps of the previous window that stand in front.
        steps: T, new steps a window.
        frame_shape: Shape of a stored frame.
        device: Device of the storage.
        task: int64 [N], the game that each env plays, where there are several.
    """

    def __init__(
        self,
        num_envs: int,
        context: int,
        steps: int,
        frame_shape: torch.Size,
        device: torch.device,
        task: torch.Tensor | None = None,
    ) -> None:
        self.num_envs, self.context, self.steps, self.length = num_envs, context, steps, context + steps
        size = (num_envs, self.length)
        self.pixels = torch.empty((*size, *frame_shape), dtype=torch.uint8, device=device)
        self.pool = FramePool(frame_shape, num_envs + max(num_envs // 2, 4), device)
        self.pool.resize(num_envs)
        self.extras: dict[NestedKey, torch.Tensor] = {}
        self._action = Rows(size, torch.int64, device)
        self._numbers = Rows((*size, NUM_NUMBERS), torch.float32, device)
        self._root = {key: torch.zeros(size, dtype=dtype, device=device) for key, dtype in _ROOT_COLUMNS.items()}
        self._slots = torch.full(size, -1, dtype=torch.int64, device=device)
        self._tail_ended = torch.zeros(num_envs, dtype=torch.bool, device=device)  # whose tail slot is a final frame
        self._next_dense: torch.Tensor | None = None
        self._task = None if task is None else task.unsqueeze(-1).repeat(1, self.length)

    @property
    def device(self) -> torch.device:
        """Device of the storage."""
        return self.pixels.device

    @property
    def done(self) -> torch.Tensor:
        """bool [N, L], where an episode ended."""
        return self._numbers.tensor[..., [TERMINATED, TRUNCATED]].any(-1)

    # -- writing ----------------------------------------------------------------------------------------------------

    def begin(self, carry_context: bool) -> None:
        """Make ready for new steps.

        Args:
            carry_context: Whether the last ``context`` steps move to the front, and are kept.
        """
        if not carry_context or not self.context:
            self.pool.resize(self.num_envs)
            self._slots.fill_(-1)
            return
        kept = self._slots[:, self.steps :].clone()
        kept[:, -1].masked_fill_(~self._tail_ended, -1)  # what followed the last step now stands in the window itself
        has_slot = kept >= 0
        frames = self.pool.pixels[kept[has_slot]]
        self.pool.resize(self.num_envs)
        kept[has_slot] = self.pool.append(frames)
        for buffer in self._buffers().values():
            # Step by step when source and target overlap; upwards, so that nothing is overwritten before it is read.
            portion = self.context if self.context <= self.steps else 1
            for first in range(0, self.context, portion):
                start = first + self.steps
                buffer[:, first : first + portion] = buffer[:, start : start + portion]
        self._slots.fill_(-1)
        self._slots[:, : self.context] = kept

    def write_action(self, step: int, frames: torch.Tensor, action: torch.Tensor) -> None:
        """Write what was seen and done: the only copy of the frames."""
        self.pixels[:, step].copy_(frames)
        self._action.write(step, action)

    def write_outcome(self, step: int, numbers: jax.Array) -> None:
        """Write what came of it, ``Step.numbers``."""
        self._numbers.write(step, numbers)

    def write_extras(self, step: int, extras: Mapping[NestedKey, torch.Tensor]) -> None:
        """Write what the actor wants stored; space is made at the first step."""
        for key, value in extras.items():
            if key not in self.extras:
                shape = (self.num_envs, self.length, *value.shape[1:])
                self.extras[key] = torch.zeros(shape, dtype=value.dtype, device=self.device)
            self.extras[key][:, step] = value

    def write_final_frames(self, steps: torch.Tensor, rows: torch.Tensor, frames: torch.Tensor) -> None:
        """Keep final frames, after the tail has been written.

        Args:
            steps: int64 [n], when the episodes ended.
            rows: int64 [n], in which envs.
            frames: uint8 [n, ...], in order of time.
        """
        last = steps == self.length - 1
        count = int((~last).sum())
        self._slots[rows[:count], steps[:count]] = self.pool.append(frames[:count])
        self.pool.pixels[rows[count:]] = frames[count:]
        self._tail_ended[rows[count:]] = True

    def write_tail(self, frames: torch.Tensor) -> None:
        """Keep the frames after the last step, slots 0 to N-1."""
        self.pool.pixels[: self.num_envs] = frames
        self._tail_ended.zero_()
        self._slots[:, -1] = torch.arange(self.num_envs, device=self.device)

    def finish(self, first: int, root: Mapping[str, torch.Tensor]) -> None:
        """Work out what each step began with, all at once.

        Args:
            first: First new step.
            root: What that step began with: last_action [N], is_init, step_count, episode_reward [N, 1].
        """
        for key, column in self._root.items():
            column[:, first] = root[key].reshape(self.num_envs)
        before, after = slice(first, self.length - 1), slice(first + 1, self.length)
        done, numbers = self.done[:, before], self._numbers.tensor[:, before]
        self._root["last_action"][:, after] = self._action.tensor[:, before]
        self._root["is_init"][:, after] = done
        self._root["step_count"][:, after] = numbers[..., STEP_COUNT].masked_fill(done, 0).to(torch.int64)
        self._root["episode_reward"][:, after] = numbers[..., EPISODE_REWARD].masked_fill(done, 0)

    # -- reading ----------------------------------------------------------------------------------------------------

    def sequences(self, initial_state: TensorDict) -> TensorDict:
        """Everything as TensorDict [N] of entries [N, L, ...]; frames and extras are views of the storage."""
        out = self._entries(0, [self.num_envs], has_pool=True)
        out["next", "frame_slot"] = self._slots.unsqueeze(-1)
        out["initial_state"] = initial_state
        out["next_pool"] = NonTensorData(self.pool, batch_size=[self.num_envs])
        return out

    def transitions(self, compact: bool) -> TensorDict:
        """The T new steps as TensorDict [N, T], in the layout of TorchRL's collectors.

        Args:
            compact: Leave ``("next", "pixels")`` out; ``next_pixels`` can still build it.
        """
        size = [self.num_envs, self.steps]
        out = self._entries(self.context, size, has_pool=compact)
        flags = torch.zeros((4, *size, 1), dtype=torch.bool, device=self.device)
        out["done"], out["terminated"], out["truncated"], out["next", "is_init"] = flags
        out["next", "last_action"] = out["action"]
        if self._task is not None:
            out["next", "task"] = out["task"]
        if compact:
            out["next", "frame_slot"] = self._slots[:, self.context :].unsqueeze(-1)
            out["next_pool"] = NonTensorData(self.pool, batch_size=size)
        else:
            out["next", "pixels"] = self._dense_next_pixels()
        out.names = [None, "time"]
        return out

    def _entries(self, first: int, batch_size: list[int], has_pool: bool) -> TensorDict:
        """Everything but what follows a step's frame, from step ``first`` on."""
        numbers = self._numbers.tensor[:, first:]
        entries: dict[NestedKey, torch.Tensor] = {
            "pixels": self.pixels[:, first:],
            "action": self._action.tensor[:, first:],
            "last_action": self._root["last_action"][:, first:],
            "is_init": self._root["is_init"][:, first:, None],
            "step_count": self._root["step_count"][:, first:, None],
            "episode_reward": self._root["episode_reward"][:, first:, None],
            ("next", "reward"): numbers[..., REWARD, None],
            ("next", "episode_reward"): numbers[..., EPISODE_REWARD, None],
            ("next", "step_count"): numbers[..., STEP_COUNT, None].to(torch.int64),
            ("next", "terminated"): numbers[..., TERMINATED, None] > 0,
            ("next", "truncated"): numbers[..., TRUNCATED, None] > 0,
            ("next", "done"): self.done[:, first:, None],
            **{key: buffer[:, first:] for key, buffer in self.extras.items()},
        }
        if self._task is not None:
            entries["task"] = self._task[:, first:]
        # With a device set, TensorDict.clone would share the pool with the storage, which the next window overwrites.
        out = TensorDict({}, batch_size=batch_size, device=None if has_pool else self.device)
        for key, value in entries.items():
            out[key] = value
        return out

    def _dense_next_pixels(self) -> torch.Tensor:
        """The frame after every new step, in a buffer that is reused."""
        if self._next_dense is None:
            self._next_dense = torch.empty_like(self.pixels[:, self.context :])
        dense, slots = self._next_dense, self._slots[:, self.context :]
        dense[:, :-1] = self.pixels[:, self.context + 1 :]
        env, step = (slots >= 0).nonzero(as_tuple=True)
        dense[env, step] = self.pool.pixels[slots[env, step]]
        return dense

    # -- resuming ---------------------------------------------------------------------------------------------------

    def _buffers(self) -> dict[NestedKey, torch.Tensor]:
        """All buffers with axes [N, L, ...] but the slots."""
        numbers = {"action": self._action.tensor, "_numbers": self._numbers.tensor}
        return {"pixels": self.pixels, **numbers, **self._root, **self.extras}

    def context_state(self) -> dict[str, Any]:
        """What the next window needs of this one, as plain tensors: nothing without a context."""
        if not self.context:
            return {}
        buffers = {**self._buffers(), "_slots": self._slots}
        return {
            "buffers": {_join(key): buffer[:, self.steps :].clone() for key, buffer in buffers.items()},
            "pool": self.pool.pixels.clone(),
            "tail_ended": self._tail_ended.clone(),
        }

    def load_context_state(self, state: dict[str, Any]) -> None:
        """Load what ``context_state`` gave.

        Raises:
            ValueError: It is of a collector with other sizes.
        """
        if bool(state) != bool(self.context):
            raise ValueError(f"the saved collector and this one differ in context, this one's is {self.context}")
        if not state:
            return
        buffers = {**self._buffers(), "_slots": self._slots}
        for name, saved in state["buffers"].items():
            key = _split(name)
            if key not in buffers:
                self.extras[key] = torch.zeros(
                    (self.num_envs, self.length, *saved.shape[2:]), dtype=saved.dtype, device=self.device
                )
                buffers[key] = self.extras[key]
            target = buffers[key][:, self.steps :]
            if target.shape != saved.shape:
                shapes = f"{tuple(saved.shape)}, this collector's {tuple(target.shape)}"
                raise ValueError(f"saved context {name!r} is {shapes}")
            target.copy_(saved)
        self.pool.resize(0)
        self.pool.append(state["pool"].to(self.device))
        self._tail_ended.copy_(state["tail_ended"])


def _join(key: NestedKey) -> str:
    """A nested key as one string."""
    return key if isinstance(key, str) else "/".join(key)


def _split(name: str) -> NestedKey:
    """The key that ``_join`` made into ``name``."""
    parts = tuple(name.split("/"))
    return parts[0] if len(parts) == 1 else parts
