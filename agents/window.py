"""Windows of experience as plain tensors, and where in them the true next observations stand.

A memory model reads a window of ``L`` observations once. The value of the observation *after* a step is then the value
at the following position, except where that holds something else: at an episode end it is the first observation of the
next episode, and after the last step there is nothing. There the final observation is **inserted** into the sequence,
right after its step, so that it is read with the recurrent state that led to it. One pass over the longer sequence
gives the exact value of every next observation for any causal memory model, and needs no recurrent state per step.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.protocols import QNetwork
from arcade_torch.agents.targets import TimeLimit

Bootstrap = Literal["next", "last"]
Key = str | tuple[str, ...]


@dataclass
class WindowKeys:
    """Names of the entries a window is read from (all configurable through ``LossModule.set_keys``)."""

    pixels: Key = "pixels"
    action: Key = "action"
    last_action: Key = "last_action"
    is_init: Key = "is_init"
    reward: Key = ("next", "reward")
    terminated: Key = ("next", "terminated")
    truncated: Key = ("next", "truncated")
    next_pixels: Key = ("next", "pixels")
    frame_slot: Key = ("next", "frame_slot")
    next_pool: Key = "next_pool"
    initial_state: Key = "initial_state"
    state: Key = "memory"

    def required(self) -> list[object]:
        """Entries that every batch must hold."""
        roots: list[object] = [self.pixels, self.action, self.last_action, self.is_init]
        return [*roots, self.reward, self.terminated, self.truncated]


@dataclass(frozen=True)
class Window:
    """B windows of L observations, with K places for final observations that were inserted.

    Attributes:
        pixels: uint8 or float [B, L, ...], the observations.
        action: int64 [B, L].
        reward: float32 [B, L].
        terminated: bool [B, L].
        truncated: bool [B, L].
        state: recurrent state before index 0, TensorDict [B].
        pool: frames that ``slot`` points into, [M, ...] as ``pixels``.
        slot: int64 [B, K], the final observations of each row in the order of time; unused places point to 0.
        order: int64 [B, L + K], for each position of the extended sequence its place in (L roots, K inserted).
        position: int64 [B, L], where each root stands in the extended sequence; ``position + 1`` is its true successor.
        last_action: int64 [B, L + K], of the extended sequence.
        is_init: bool [B, L + K], of the extended sequence.
        inserted: per row the number of places in use (host integers, so that choosing K needs no synchronisation).
        shuffled: per row whether something is inserted before the end.
        extras: what a learner wants to have beside the experience, each [B, ...].
    """

    pixels: Tensor
    action: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    state: TensorDictBase
    pool: Tensor
    slot: Tensor
    order: Tensor
    position: Tensor
    last_action: Tensor
    is_init: Tensor
    inserted: list[int]
    shuffled: list[bool]
    extras: dict[str, Tensor] = field(default_factory=dict)

    def rows(self, index: list[int]) -> "Window":
        """The windows of some rows, with only as many inserted places as these rows use.

        Args:
            index: row numbers.

        Returns:
            A window of ``len(index)`` rows (copies, the frame pool is shared).
        """
        rows = torch.tensor(index, device=self.action.device)
        inserted = [self.inserted[i] for i in index]
        width = max(inserted)
        total = self.action.shape[1] + width
        return Window(
            pixels=self.pixels.index_select(0, rows),
            action=self.action.index_select(0, rows),
            reward=self.reward.index_select(0, rows),
            terminated=self.terminated.index_select(0, rows),
            truncated=self.truncated.index_select(0, rows),
            state=self.state[rows],
            pool=self.pool,
            slot=self.slot[:, :width].index_select(0, rows),
            order=self.order[:, :total].index_select(0, rows),
            position=self.position.index_select(0, rows),
            last_action=self.last_action[:, :total].index_select(0, rows),
            is_init=self.is_init[:, :total].index_select(0, rows),
            inserted=inserted,
            shuffled=[self.shuffled[i] for i in index],
            extras={name: value.index_select(0, rows) for name, value in self.extras.items()},
        )

    def roots(self) -> "Window":
        """The same without the final observations that were inserted: L positions, for a pass that needs no targets."""
        num_rows, length = self.action.shape
        order = torch.arange(length, device=self.action.device).expand(num_rows, -1)
        return replace(
            self,
            slot=self.slot[:, :0],
            order=order,
            position=order,
            last_action=self.last_action.gather(1, self.position),
            is_init=self.is_init.gather(1, self.position),
            inserted=[0] * num_rows,
            shuffled=[False] * num_rows,
        )

    def with_extras(self, **extras: Tensor) -> "Window":
        """The same with further entries [B, ...]."""
        return replace(self, extras={**self.extras, **extras})

    def extend(self, features: Tensor, inserted: Tensor) -> Tensor:
        """Put the inserted places where they belong.

        Args:
            features: float [B, L, E], of the roots.
            inserted: float [B, K, E], of the final observations.

        Returns:
            float [B, L + K, E], in the order of time.
        """
        both = torch.cat((features, inserted), dim=1)
        if not any(self.shuffled):
            return both
        rows, total = both.shape[:2]
        start = torch.arange(rows, device=both.device).unsqueeze(1) * total
        return both.flatten(0, 1).index_select(0, (self.order + start).flatten()).view_as(both)


def outputs_along(network: QNetwork, window: Window, state: TensorDictBase | None = None) -> Tensor:
    """Read a window once.

    Args:
        network: what reads it.
        window: the experience.
        state: recurrent state before index 0, TensorDict [B]; default that of the window.

    Returns:
        float [B, L + K, A], outputs along the extended sequence. The features of inserted observations carry no
        gradient: they only lend their value.
    """
    features = network.encode(window.pixels)
    if window.slot.shape[1]:
        with torch.no_grad():
            inserted = network.encode(window.pool[window.slot])
        features = window.extend(features, inserted)
    out, _ = network.remember(features, window.last_action, window.is_init, window.state if state is None else state)
    return out


def read_window(
    batch: TensorDictBase,
    keys: WindowKeys,
    time_limit: TimeLimit,
    bootstrap: Bootstrap,
    initial_state: Callable[[int], TensorDictBase],
) -> Window:
    """Read sequences [B] of an ``ArcadeCollector``, or a stock TorchRL batch [B, T], into plain tensors.

    Args:
        batch: the experience. A stock batch needs dense ``("next", "pixels")``.
        keys: names of its entries.
        time_limit: whether truncated steps bootstrap from their final observation.
        bootstrap: ``"next"``: the last step needs its next observation; ``"last"``: it only lends its own value.
        initial_state: gives the state of a fresh start; used where the batch stores none.

    Returns:
        All rows of the batch.

    Raises:
        ValueError: an observation that a target needs was not stored, or the recurrent state at index 0 is not known.
    """
    action = _flat(batch, keys.action)
    is_init = _flat(batch, keys.is_init)
    terminated, truncated = _flat(batch, keys.terminated), _flat(batch, keys.truncated)
    needed = ~(terminated | truncated) if time_limit == "terminal" else ~terminated
    needed[:, :-1] &= is_init[:, 1:]
    if bootstrap == "last":
        needed[:, -1] = False
    pool, frame_slot = _final_frames(batch, keys, needed)
    return _plan(
        pixels=batch.get(keys.pixels),
        action=action,
        reward=_flat(batch, keys.reward),
        terminated=terminated,
        truncated=truncated,
        state=_state(batch, keys, is_init, initial_state),
        last_action=_flat(batch, keys.last_action),
        is_init=is_init,
        needed=needed,
        pool=pool,
        frame_slot=frame_slot,
    )


def _plan(
    *,
    pixels: Tensor,
    action: Tensor,
    reward: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    state: TensorDictBase,
    last_action: Tensor,
    is_init: Tensor,
    needed: Tensor,
    pool: Tensor,
    frame_slot: Tensor,
) -> Window:
    """Lay out the extended sequence: each needed final observation right after its step."""
    num_rows, length = action.shape
    inserted: list[int] = needed.sum(1).tolist()
    width = max(inserted)
    before = needed.cumsum(1) - needed.long()
    position = torch.arange(length, device=action.device) + before
    row, step = needed.nonzero(as_tuple=True)
    rank = before[row, step]
    order = torch.arange(length + width, device=action.device).repeat(num_rows, 1)
    order.scatter_(1, position, torch.arange(length, device=action.device).expand(num_rows, -1))
    order[row, position[row, step] + 1] = length + rank
    slot = action.new_zeros(num_rows, width)
    slot[row, rank] = frame_slot[row, step]
    led_by = last_action.new_zeros(num_rows, width)
    led_by[row, rank] = action[row, step].to(last_action.dtype)
    return Window(
        pixels=pixels,
        action=action,
        reward=reward,
        terminated=terminated,
        truncated=truncated,
        state=state,
        pool=pool,
        slot=slot,
        order=order,
        position=position,
        last_action=torch.cat((last_action, led_by), 1).gather(1, order),
        is_init=torch.cat((is_init, is_init.new_zeros(num_rows, width)), 1).gather(1, order),
        inserted=inserted,
        shuffled=needed[:, :-1].any(1).tolist(),
    )


def _final_frames(batch: TensorDictBase, keys: WindowKeys, needed: Tensor) -> tuple[Tensor, Tensor]:
    """The frames that may be inserted, and for each step its place among them."""
    slots = batch.get(keys.frame_slot, None)
    if slots is not None:
        frame_slot = slots.flatten(2).squeeze(-1) if slots.ndim > 2 else slots
        missing = int((needed & (frame_slot < 0)).sum())
        if missing:
            raise ValueError(
                f"{missing} next observations are needed but were not stored; "
                "collect with final_frames='truncated' or 'all', or use time_limit='terminal'"
            )
        return batch[keys.next_pool].pixels, frame_slot
    dense = batch.get(keys.next_pixels, None)
    if dense is None:
        raise ValueError(
            f"next observations are needed; the batch holds neither {keys.frame_slot} nor {keys.next_pixels}"
        )
    rows, steps = needed.shape
    return dense.flatten(0, 1), torch.arange(rows * steps, device=needed.device).view(rows, steps)


def _state(
    batch: TensorDictBase, keys: WindowKeys, is_init: Tensor, initial_state: Callable[[int], TensorDictBase]
) -> TensorDictBase:
    state: TensorDictBase | None = batch.get(keys.initial_state, None)
    if state is not None:
        return state
    steps = batch.get(keys.state, None)
    if steps is not None:
        return steps[:, 0]
    fresh = initial_state(is_init.shape[0])
    if not fresh.is_empty() and not bool(is_init[:, 0].all()):
        raise ValueError(
            f"the batch starts in mid-episode but holds no recurrent state; store {keys.initial_state!r} [B] or "
            f"{keys.state!r} [B, T]"
        )
    return fresh


def _flat(batch: TensorDictBase, key: Key) -> Tensor:
    """An entry [B, L] or [B, L, 1] as [B, L]."""
    value: Tensor = batch.get(key)
    return value.squeeze(-1) if value.ndim == 3 else value
