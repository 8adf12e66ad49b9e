"""Several batches of envs side by side in one: seeds by group, and a collector's state taken apart and put together.

Env ``i`` of group ``g`` is env ``g * N + i`` of the whole, and plays as it would in a batch of its own.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax.batch import env_keys

State = dict[str, Any]


def seed_groups(env: ArcadeEnv, seeds: Sequence[int]) -> None:
    """Seed the envs of every group as ``set_seed`` seeds a batch of that size; takes effect at the next reset.

    Args:
        env: N envs for each seed.
        seeds: One a group.

    Raises:
        ValueError: The envs cannot be split evenly, or a seed is out of range.
    """
    if not seeds or env.num_envs % len(seeds):
        raise ValueError(f"{env.num_envs} envs cannot be split evenly among {len(seeds)} seeds")
    each = env.num_envs // len(seeds)
    keys = np.concatenate([np.asarray(env_keys(seed, each)) for seed in seeds])
    state = env.get_state()
    state["key"] = torch.from_numpy(keys.view(np.int32).copy()).to(env.device)
    state["last_action"].zero_()
    env.set_state(state)


def split_collector_state(state: State, groups: int) -> list[State]:
    """Take apart what ``ArcadeCollector.state_dict`` gave.

    Args:
        state: Of a collector with groups * N envs.
        groups: Number of groups.

    Returns:
        For each group what a collector of its own would have given.
    """
    total, steps, context = state["sizes"]
    each = total // groups
    parts: list[State] = []
    for first in range(0, total, each):
        rows = slice(first, first + each)
        part = {**state, "frames": state["frames"] // groups, "sizes": [each, steps, context]}
        part["env_state_dict"] = _nested(lambda x, r=rows: x[r].clone(), state["env_state_dict"])
        if "recurrent_state" in state:
            part["recurrent_state"] = _nested(lambda x, r=rows: x[r].clone(), state["recurrent_state"])
            starts = state["window_starts"]
            part["window_starts"] = [_nested(lambda x, r=rows: x[r].clone(), start) for start in starts]
            part["context"] = _split_context(state["context"], rows, total)
            part["traj_ids"], part["next_traj_id"] = torch.arange(each, device=state["traj_ids"].device), each
        parts.append(part)
    return parts


def join_collector_states(states: Sequence[State]) -> State:
    """The inverse of :func:`split_collector_state`; the states may come from collectors of their own.

    Args:
        states: One a group, taken after equally many steps.

    Returns:
        What a collector of all the envs loads.

    Raises:
        ValueError: They are of different sizes, or of different moments.
    """
    first = states[0]
    for name in ("sizes", "frames", "iter", "acted"):
        values = [state[name] for state in states]
        if any(value != values[0] for value in values):
            raise ValueError(f"the saved collectors differ in {name}: {', '.join(map(str, values))}")
    each, steps, context = first["sizes"]
    total = each * len(states)
    whole = {**first, "frames": first["frames"] * len(states), "sizes": [total, steps, context]}
    whole["env_state_dict"] = _cat([state["env_state_dict"] for state in states])
    if "recurrent_state" in first:
        whole["recurrent_state"] = _cat([state["recurrent_state"] for state in states])
        starts = zip(*(state["window_starts"] for state in states), strict=True)
        whole["window_starts"] = [_cat(list(parts)) for parts in starts]
        whole["context"] = _join_contexts([state["context"] for state in states], each)
        whole["traj_ids"], whole["next_traj_id"] = torch.arange(total, device=first["traj_ids"].device), total
    return whole


def _split_context(context: State, rows: slice, total: int) -> State:
    """One group's rows; of the pool its tail frames, and the final frames that its rows point to, renumbered."""
    if not context:
        return {}
    each = rows.stop - rows.start
    buffers = {name: buffer[rows].clone() for name, buffer in context["buffers"].items()}
    slots, pool = buffers["_slots"], context["pool"]
    final = slots >= total
    frames = torch.cat([pool[rows], pool[slots[final]]])
    tail = (slots >= 0) & ~final
    slots[tail] -= rows.start
    slots[final] = each + torch.arange(len(frames) - each, device=slots.device)
    return {"buffers": buffers, "pool": frames, "tail_ended": context["tail_ended"][rows].clone()}


def _join_contexts(contexts: Sequence[State], each: int) -> State:
    """All tail frames first, as a collector of all the envs has them, then the final frames of every group."""
    if not contexts[0]:
        return {}
    total = each * len(contexts)
    tails, finals = [c["pool"][:each] for c in contexts], [c["pool"][each:] for c in contexts]
    slots, found = [], total
    for group, (context, final) in enumerate(zip(contexts, finals, strict=True)):
        own = context["buffers"]["_slots"]
        tail = torch.where(own >= 0, own + group * each, own)
        slots.append(torch.where(own >= each, own - each + found, tail))
        found += len(final)
    buffers = _cat([c["buffers"] for c in contexts]) | {"_slots": torch.cat(slots)}
    ended = torch.cat([c["tail_ended"] for c in contexts])
    return {"buffers": buffers, "pool": torch.cat(tails + finals), "tail_ended": ended}


def _nested(function: Any, nested: State) -> State:
    """Apply a function to the tensors of nested dictionaries."""
    return {k: _nested(function, v) if isinstance(v, dict) else function(v) for k, v in nested.items()}


def _cat(nested: Sequence[State]) -> State:
    """Join the tensors of nested dictionaries of one form along their first dimension."""
    return {
        key: _cat([one[key] for one in nested]) if isinstance(value, dict) else torch.cat([one[key] for one in nested])
        for key, value in nested[0].items()
    }
