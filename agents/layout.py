"""Final observations put where they belong, so that one pass over a window gives the value of every
next observation.

A memory model reads a window of ``L`` observations once. The value of the observation *after* a
step is then the value at the following position, but for two cases: where an episode ended, the
next position holds the first observation of the next episode, and after the last step there is
none. There the true next observation is inserted right after its step, where the recurrent state
that led to it reads it. For a causal memory the pass over ``L + K`` positions is exact, and because
a batch has a fixed number of places ``K``, all shapes are static.
"""

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from arcade_torch.agents.batch_checks import (
    Key,
    NetworkInputs,
    check_order,
    check_stored_states,
    entry,
    flat,
    is_stock,
    written,
)
from arcade_torch.models.memory import step_mask
from arcade_torch.models.networks import MemoryNetwork


def insert_final_observations(
    batch: TensorDictBase,
    inputs: NetworkInputs,
    time_limit: str = "bootstrap",
    burn_in: int = 0,
    **names: Key,
) -> TensorDict:
    """Lay out a batch for a pass that gives the values of all next observations.

    Args:
        batch: sequences [N] of ``ArcadeCollector.collect()`` or rows of them, or a stock TorchRL
            batch [..., L] with dense ``("next", ...)`` observations, read as [N, L]. Entries: what
            the network reads, ``action``, ``is_init``, ``("next", "reward" | "terminated" |
            "truncated")``, or ``done`` in the place of the last; the recurrent state as
            ``initial_state`` [N], or per step under the network's keys (not needed where all rows
            begin with an episode).
        inputs: of the network.
        time_limit: ``"bootstrap"``: a truncated step needs its true next observation;
            ``"terminal"``: it does not.
        burn_in: first steps that only bring the recurrent state up to date; they are kept apart.
        **names: other names of ``action``, ``is_init``, ``reward``, ``done``, ``terminated``,
            ``truncated``.

    Returns:
        TensorDict [N] with ``extended`` [N, L + K] (what the network reads), ``position`` int64 [N,
        L] (where each step's observation stands; its true successor stands right behind it),
        ``burn_in`` [N, burn_in], ``initial_state`` [N], ``reward``, ``terminated``, ``cut`` (the
        episode or its record ends here), and ``action``, ``stored_target`` (DQN's) and ``mask`` (of
        padded rows), if the batch has them, [N, L, ...]; L without burn-in.

    Raises:
        KeyError: an entry is missing; names it.
        ValueError: a needed next observation or the state at step 0 is missing, or steps do not
            follow each other.
    """
    batch = _as_sequences(_rename(batch, names), inputs, burn_in)
    mask = step_mask(batch, flat(batch, "is_init").shape)
    terminated, cut = _ends(batch, mask, time_limit)
    check_order(batch, cut, mask, has_memory=bool(inputs.state_keys))

    # The true next observation is needed where the record stops but the task goes on.
    final_steps, used = _final_places(batch, needed=cut & ~terminated)
    order, position = _order_in_time(cut.shape[1], final_steps, used, burn_in)

    outcomes = {"terminated": terminated, "cut": cut}
    outcomes["reward"] = _in_full(flat(batch, ("next", "reward")))
    outcomes["action"] = entry(batch, "action")
    if mask is not None:
        outcomes["mask"] = mask
        outcomes["reward"] = outcomes["reward"].where(mask, 0)  # NaN times a trace of 0 is NaN
    if "stored_target" in batch:
        outcomes["stored_target"] = batch["stored_target"]

    out = TensorDict({"position": position}, batch_size=[len(cut)])
    for name, outcome in outcomes.items():
        out[name] = outcome[:, burn_in:]
    _add_observations(out, batch, inputs, final_steps, order, burn_in)
    _add_state(out, batch, inputs)
    return out


def _rename(batch: TensorDictBase, names: dict[str, Key]) -> TensorDictBase:
    """A copy of the batch with the entries that have other names under ours as well."""
    if "steps_to_next_obs" in batch:
        raise ValueError(
            "the batch must be one without MultiStep: use lmbda; got 'steps_to_next_obs'"
        )
    batch = batch.copy()
    truncated = unravel_key(("next", names.get("truncated", "truncated")))
    done = unravel_key(("next", names.pop("done", "done")))
    # an env of TorchRL need not have it; done is there, and beside terminated it says the same
    if truncated not in batch and done in batch:
        batch[truncated] = batch[done]
    for name, given in names.items():
        if name in ("reward", "terminated", "truncated"):
            batch["next", name] = entry(batch, unravel_key(("next", given)))
        else:
            batch[name] = entry(batch, given)
    return batch


def _as_sequences(batch: TensorDictBase, inputs: NetworkInputs, burn_in: int) -> TensorDictBase:
    """The batch with one sequence a row, entries [N, L, ...], and start flags [N, L, 1]."""
    if is_stock(batch):
        check_stored_states(batch, inputs)
        if burn_in and batch.ndim == 1 and bool(batch["is_init"][1:].any()):
            raise ValueError(
                "burn_in must be 0 for a flat batch of several slices: reshape it to [slices, "
                f"length]; got {burn_in}"
            )
        batch = batch.reshape(-1, batch.shape[-1])
    is_init = flat(batch, "is_init").bool()
    for key in inputs.start_keys:
        if key in batch:
            batch[key] = flat(batch, key).bool().unsqueeze(-1)
    if burn_in >= is_init.shape[1]:
        raise ValueError(
            f"burn_in must be less than the {is_init.shape[1]} steps of the batch; got {burn_in}"
        )
    return batch


def _ends(batch: TensorDictBase, mask: Tensor | None, time_limit: str) -> tuple[Tensor, Tensor]:
    """Behind which steps the task ends, and behind which an episode or its record ends; bool [N,
    L].
    """
    terminated = flat(batch, ("next", "terminated")).bool()
    done = terminated | flat(batch, ("next", "truncated")).bool()
    is_init = flat(batch, "is_init")

    # The record ends where the next step opens an episode, and with the last step of a row.
    last = torch.ones_like(is_init[:, :1])
    cut = done | torch.cat((is_init[:, 1:], last), dim=1)

    # TorchRL pads trajectories: zeros follow, up to the length of the longest.
    if mask is not None:
        cut[:, :-1] |= mask[:, :-1] & ~mask[:, 1:]

    if time_limit == "terminal":
        terminated = done
    return terminated, cut


def _in_full(reward: Tensor) -> Tensor:
    """Rewards in single precision at least: discounts in half would be off by a thousandth, and
    those of whole numbers 0.
    """
    is_full = reward.is_floating_point() and reward.itemsize >= torch.float32.itemsize
    return reward if is_full else reward.float()


def _final_places(batch: TensorDictBase, needed: Tensor) -> tuple[Tensor, Tensor]:
    """Steps [N, K] whose next observation is at hand, and which of these places are needed.

    Whether any is missing is asked where the answer is free: on a GPU the host would wait for it,
    so there the batches of ``ArcadeCollector``, which has stored what is needed, are taken as they
    are.
    """
    final_steps = batch.get("final_index", None)
    is_trusted = final_steps is not None and needed.device.type != "cpu"
    if final_steps is None:
        count = max(int(needed.sum(1).max()), 1)  # a stock batch has as many places as it needs
        needed_first = (~needed).to(torch.uint8).argsort(dim=1, stable=True)
        final_steps = needed_first[:, :count]
    used = needed.gather(1, final_steps) & batch.get("final_mask", needed.new_ones(()))
    missing = 0 if is_trusted else int(needed.sum() - used.sum())
    if missing:
        raise ValueError(
            "next observations must be stored where needed: collect with final_frames='truncated' "
            f"or 'all', or take time_limit='terminal'; got {missing} missing"
        )
    return final_steps, used


def _order_in_time(
    steps: int, final_steps: Tensor, used: Tensor, burn_in: int
) -> tuple[Tensor, Tensor]:
    """Sort observations and final observations by time.

    The observation of step t comes at time 2 t, the true next one, if it is used, at 2 t + 1; the
    places that are not used come last.

    Returns:
        ``order`` int64 [N, L + K]: what stands at each position, where L and above are final
        observations; ``position`` int64 [N, L]: where the observation of each step stands.
    """
    length = steps - burn_in
    step = torch.arange(length, device=final_steps.device).expand(len(final_steps), -1)
    final_step = final_steps - burn_in
    final_time = torch.where(used & (final_step >= 0), 2 * final_step + 1, 2 * length)
    time = torch.cat((2 * step, final_time), dim=1)
    order = time.argsort(dim=1, stable=True)
    position = order.argsort(dim=1)[:, :length]
    return order, position


def _add_observations(
    out: TensorDict,
    batch: TensorDictBase,
    inputs: NetworkInputs,
    final_steps: Tensor,
    order: Tensor,
    burn_in: int,
) -> None:
    """Write ``extended``, observations and final observations in the order of time, and
    ``burn_in``, the observations before.
    """
    keys = list(inputs.observation_keys)
    if not inputs.reads_first_state_only and _stored_state(batch) is None:
        # a stock batch has a state for every step
        keys += [key for key in inputs.state_keys if key in batch]

    extended = TensorDict(batch_size=order.shape)
    before = TensorDict(batch_size=[len(order), burn_in])
    for key in keys:
        observation = entry(batch, key)
        if key in inputs.state_keys:
            observation = observation.detach()  # what was stored is no way back to older steps
        final = _next(batch, key, final_steps, inputs)
        both = torch.cat((observation[:, burn_in:], final), dim=1)
        extended[key] = _rows(both, order)
        before[key] = observation[:, :burn_in]
    out["extended"] = extended
    if burn_in:
        out["burn_in"] = before


def _next(batch: TensorDictBase, key: Key, steps: Tensor, inputs: NetworkInputs) -> Tensor:
    """An entry [N, K, ...] of the observations behind the steps [N, K]. Its start flags are false,
    so that states that are stored there are not read.
    """
    if key in inputs.start_keys:
        return torch.zeros_like(steps, dtype=torch.bool).unsqueeze(-1)
    final = batch.get(inputs.final_keys[key], None)
    if final is not None:
        return final  # type: ignore[no-any-return]
    value = batch.get(unravel_key(("next", key)), None)
    if value is None and key == "last_action":
        value = batch.get("action", None)
    if value is None and key in inputs.state_keys:
        value = batch.get(key, None)
    if value is None:
        raise KeyError(
            f"no next observations: neither {inputs.final_keys[key]!r} nor ('next', {key!r}): "
            "collect with compact_obs=False, or with final_frames='all'; or take what "
            "ArcadeCollector.collect() gives"
        )
    return _rows(value, steps)


def _rows(value: Tensor, index: Tensor) -> Tensor:
    """Entries [N, K, ...] of [N, L, ...] at the steps ``index`` [N, K]."""
    first_of_row = torch.arange(len(index), device=index.device).unsqueeze(1) * value.shape[1]
    flat_index = (index + first_of_row).flatten()
    chosen = value.flatten(0, 1).index_select(0, flat_index)
    return chosen.view(*index.shape, *value.shape[2:])


def _check_states(first: TensorDictBase, inputs: NetworkInputs) -> None:
    """Refuse an ``initial_state`` without what a network reads (ValueError)."""
    missing = [key for key in inputs.state_keys if key not in first]
    if missing:
        raise ValueError(
            f"initial_state must hold {missing[0]!r}, which a network of the loss reads: let it "
            "run while collecting, TensorDictSequential(critic, actor); got "
            f"{', '.join(map(str, first.keys()))}"
        )


def _add_state(out: TensorDict, batch: TensorDictBase, inputs: NetworkInputs) -> None:
    """Write ``initial_state``, the recurrent state before the first step."""
    if not inputs.state_keys:
        return
    first = _stored_state(batch)
    if first is not None:
        _check_states(first, inputs)
        out["initial_state"] = first.select(*inputs.state_keys).detach()
        return

    missing = [key for key in inputs.state_keys if key not in batch]
    if not missing:
        state = TensorDict(batch_size=out.batch_size)
        for key in inputs.state_keys:
            state[key] = batch[key][:, 0].detach()
        out["initial_state"] = state
    elif not bool(batch["is_init"][:, 0].all()):
        raise ValueError(
            f"the batch begins in mid-episode but has neither 'initial_state' nor {missing[0]!r}"
        )


def _stored_state(batch: TensorDictBase) -> TensorDictBase | None:
    """The ``initial_state`` of sequences; an observation of that name is none."""
    state = batch.get("initial_state", None)
    return state if isinstance(state, TensorDictBase) else None


def unroll(
    network: TensorDictModuleBase, inputs: NetworkInputs, sequences: TensorDictBase, key: Key
) -> Tensor:
    """Read sequences once.

    Args:
        network: what reads them; its parameters may be functional.
        inputs: of the network.
        sequences: [B], rows of what :func:`insert_final_observations` gave.
        key: the output wanted.

    Returns:
        float [B, L + K, ...], the output along the extended sequence.

    Raises:
        KeyError: the network does not write it.
    """
    extended = sequences["extended"]
    state = sequences.get("initial_state", None)
    burn_in = sequences.get("burn_in", None)
    if burn_in is not None and inputs.state_keys:
        state = _state_after(burn_in, state, network, inputs)
        state = _loaded_at_start(extended[:, 0], state, inputs)
    if isinstance(network, MemoryNetwork) and network.store == "sequence" and key in network.heads:
        # the same without a TensorDict in between
        return network.read_sequences(extended, state)[key]
    extended = extended.copy()
    if state is not None:
        _begin_with(extended, state, inputs)
    with set_recurrent_mode(True):
        return written(network(extended), key, network)


@torch.no_grad()
def _state_after(
    burn_in: TensorDictBase,
    state: TensorDictBase | None,
    network: TensorDictModuleBase,
    inputs: NetworkInputs,
) -> TensorDictBase:
    """The recurrent state [B] that steps [B, T] lead to from a state [B], one step a call. Without
    gradient: they only bring the state up to date (R2D2).
    """
    with set_recurrent_mode(False):
        for t in range(burn_in.shape[1]):
            step = _with_state(burn_in[:, t], state, inputs)
            if t == 0 and state is not None and inputs.loads_at_starts:
                _clear_starts(step, inputs)  # as in a pass over time
            state = network(step).get("next").select(*inputs.state_keys)
    assert state is not None
    return state


def _with_state(
    step: TensorDictBase, state: TensorDictBase | None, inputs: NetworkInputs
) -> TensorDictBase:
    """A step [B] that goes on from a state [B]; rows that begin an episode go on from the state
    that is stored with the step. If none is, the network begins anew by itself, as when it acted.
    """
    step = step.copy()
    if state is None:
        return step
    if any(key in step for key in inputs.state_keys):
        state = _loaded_at_start(step, state, inputs)
        _clear_starts(step, inputs)
    return step.update(state)


def _clear_starts(step: TensorDictBase, inputs: NetworkInputs) -> None:
    """Let nothing begin at a step: its flags would drop the state that was loaded."""
    for key in inputs.start_keys:
        if key in step:
            step[key] = torch.zeros_like(step[key])


def _loaded_at_start(
    step: TensorDictBase, state: TensorDictBase, inputs: NetworkInputs
) -> TensorDictBase:
    """A state [B]; rows in which the step [B] begins an episode have the state that is stored with
    the step instead, or zeros.
    """
    starts = [key for key in inputs.start_keys if key in step]
    if inputs.reads_first_state_only or not starts:
        return state
    stored = state.clone().zero_().update(step.select(*inputs.state_keys, strict=False))
    return stored.where(step[starts[0]].squeeze(-1), state)


def _begin_with(sequences: TensorDictBase, state: TensorDictBase, inputs: NetworkInputs) -> None:
    """Write states [B] to the first step of sequences [B, T]. At later steps stored states stay;
    where none are stored they are zero.
    """
    for key in inputs.state_keys:
        first = state.get(key)
        states = first.unsqueeze(1).expand(-1, sequences.shape[1], *first.shape[1:])  # a view
        if not inputs.reads_first_state_only:
            stored = sequences.get(key, torch.zeros_like(states))
            states = torch.cat((states[:, :1], stored[:, 1:]), dim=1)
        sequences[key] = states


def as_steps(batch: TensorDictBase, inputs: NetworkInputs, *keys: Key) -> TensorDictBase:
    """Sequences [N] as a batch [N, L] that recurrent modules and TorchRL's losses read.

    Args:
        batch: sequences [N] of ``ArcadeCollector.collect()``, or rows of them; a stock batch [B, T]
            is given back.
        inputs: of the networks that will read it.
        *keys: further entries to keep.

    Returns:
        TensorDict [N, L] with start flags [N, L, 1]; the recurrent state counts at index 0 and
        where an episode begins.
    """
    if is_stock(batch):
        check_stored_states(batch, inputs)
        return _with_flags(batch, inputs)
    out = TensorDict(batch_size=flat(batch, "is_init").shape)
    for key in (*inputs.observation_keys, *keys):
        out[key] = entry(batch, key)
    if inputs.state_keys:
        _check_states(batch["initial_state"], inputs)
        _begin_with(out, batch["initial_state"], inputs)
    return _with_flags(out, inputs)


def _with_flags(batch: TensorDictBase, inputs: NetworkInputs) -> TensorDictBase:
    """The batch with start flags bool [*, L, 1]."""
    for key in inputs.start_keys:
        flags = batch.get(key, None)
        if flags is not None and (flags.shape == batch.shape or flags.dtype != torch.bool):
            batch = batch.copy().set(key, flags.bool().reshape(*batch.shape, 1))
    return batch
