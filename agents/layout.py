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

from arcade_torch.models.memory import MemoryModule
from arcade_torch.models.networks import MemoryNetwork

Key = str | tuple[str, ...]


class NetworkInputs:
    """Which entries of a batch a TensorDict module reads; a key that it also writes under "next" is
    recurrent state.
    """

    def __init__(self, network: TensorDictModuleBase) -> None:
        keys = [unravel_key(key) for key in network.in_keys]
        written = {unravel_key(key) for key in network.out_keys}
        self.state_keys = [key for key in keys if unravel_key(("next", key)) in written]
        self.observation_keys = [key for key in keys if key not in self.state_keys]
        self.stores = {
            m.store for m in network.modules() if isinstance(m, MemoryModule | MemoryNetwork)
        }
        self.reads_first_state_only = self.stores == {"sequence"}


def is_stock(batch: TensorDictBase, is_init: Key = "is_init") -> bool:
    """Whether a batch has TorchRL's layout [..., L], not that of sequences [N] with entries [N, L,
    ...].
    """
    return batch.ndim != 1 or _get(batch, is_init).ndim == 2


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
            "truncated")``; the recurrent state before step 0 as ``initial_state`` [N], or per step
            under the network's own keys (not needed where all rows begin with an episode).
            TorchRL's masks of padded steps, ``mask`` and ``("collector", "mask")``, are looked at.
        inputs: of the network.
        time_limit: ``"bootstrap"``: a truncated step needs its true next observation;
            ``"terminal"``: it does not.
        burn_in: first steps that only bring the recurrent state up to date; they are kept apart.
        **names: where ``action``, ``is_init``, and under "next" ``reward``, ``terminated``,
            ``truncated`` stand, if not under these names.

    Returns:
        TensorDict [N] with ``extended`` [N, L + K] (what the network reads), ``position`` int64 [N,
        L] (where each step's observation stands; its true successor stands right behind it),
        ``burn_in`` [N, burn_in], ``initial_state`` [N], ``reward``, ``terminated``, ``cut`` (the
        episode or its record ends here), and ``action``, ``stored_target`` (DQN's, if the batch has
        it) [N, L, ...]; L without burn-in.

    Raises:
        KeyError: an entry is missing; names it.
        ValueError: a needed next observation or the state at step 0 is missing, or steps do not
            follow each other.
    """
    if "steps_to_next_obs" in batch:
        raise ValueError(
            "the batch must be one without MultiStep: use lmbda; got 'steps_to_next_obs'"
        )
    batch = batch.copy()
    for wanted, name in names.items():
        after = wanted in ("reward", "terminated", "truncated")
        batch[("next", wanted) if after else wanted] = _get(
            batch, unravel_key(("next", name)) if after else name
        )
    if is_stock(batch):
        _check_stored_states(batch, inputs)
        slices = bool(burn_in) and batch.ndim == 1 and bool(batch["is_init"][1:].any())
        if slices:
            raise ValueError(
                "burn_in must be 0 for a flat batch of several slices: reshape it to [slices, "
                f"length]; got {burn_in}"
            )
        batch = batch.reshape(-1, batch.shape[-1])
    is_init = _flat(batch, "is_init")
    batch["is_init"] = is_init.unsqueeze(-1)
    terminated = _flat(batch, ("next", "terminated"))
    truncated = _flat(batch, ("next", "truncated"))
    done = terminated | truncated
    cut = done | torch.cat((is_init[:, 1:], torch.ones_like(is_init[:, :1])), dim=1)
    for key in ("mask", ("collector", "mask")):
        if key in batch and (mask := _flat(batch, key)).shape == cut.shape:
            # zeros follow, up to the length of the longest trajectory
            cut[:, :-1] |= mask[:, :-1] & ~mask[:, 1:]
    if burn_in >= is_init.shape[1]:
        raise ValueError(
            f"burn_in must be less than the {is_init.shape[1]} steps of the batch; got {burn_in}"
        )
    terminated = done if time_limit == "terminal" else terminated
    if (
        "final_index" not in batch
        and "step_count" in batch
        and (counted := ("next", "step_count")) in batch
    ):
        follows = cut[:, :-1] | (_flat(batch, counted)[:, :-1] == _flat(batch, "step_count")[:, 1:])
        if not bool(follows.all()):
            raise ValueError(
                "step_count must be that of whole sequences, never shuffled; got a jump within a "
                "row"
            )
    needed = cut & ~terminated
    index, used = _final_places(batch, needed)

    length = is_init.shape[1] - burn_in
    steps = torch.arange(length, device=is_init.device).expand(len(is_init), -1)
    times = torch.cat(
        (2 * steps, torch.where(used & (index >= burn_in), 2 * (index - burn_in) + 1, 2 * length)),
        dim=1,
    )
    # a place stands right behind its step, unused ones at the end
    order = times.argsort(dim=1, stable=True)
    position = order.argsort(dim=1)[:, :length]  # of each observation

    whole = {"terminated": terminated, "cut": cut, "reward": _flat(batch, ("next", "reward"))}
    whole |= {
        key: _get(batch, key)
        for key in ("action", "stored_target")
        if key == "action" or key in batch
    }
    out = TensorDict(
        {key: value[:, burn_in:] for key, value in whole.items()}, batch_size=[len(is_init)]
    )
    out["position"] = position
    roots = {key: _get(batch, key) for key in inputs.observation_keys}
    # states of a stock batch
    if not inputs.reads_first_state_only and "initial_state" not in batch:
        roots |= {key: batch[key] for key in inputs.state_keys if key in batch}
    both = {
        key: torch.cat((root[:, burn_in:], _next(batch, key, index, inputs)), 1)
        for key, root in roots.items()
    }
    out["extended"] = TensorDict(
        {key: _rows(value, order) for key, value in both.items()}, batch_size=order.shape
    )
    if burn_in:
        out["burn_in"] = TensorDict(
            {key: root[:, :burn_in] for key, root in roots.items()}, [len(is_init), burn_in]
        )
    if inputs.state_keys:
        _add_state(out, batch, inputs, burn_in)
    return out


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
    """
    state, burn_in, extended = (
        sequences.get(key, None) for key in ("initial_state", "burn_in", "extended")
    )
    # no gradient: it only brings the state up to date (R2D2)
    if burn_in is not None and inputs.state_keys:
        with torch.no_grad(), set_recurrent_mode(False):
            for t in range(burn_in.shape[1]):
                step = _with_state(burn_in[:, t], state, inputs)
                state = network(step).get("next").select(*inputs.state_keys)
            state = _with_state(extended[:, 0], state, inputs).select(*inputs.state_keys)
    if isinstance(network, MemoryNetwork) and network.store == "sequence" and key in network.heads:
        # the same without a TensorDict in between
        return network.read_sequences(extended, state)[key]
    extended = extended.copy()
    if state is not None:
        _begin_with(extended, state, inputs)
    with set_recurrent_mode(True):
        return network(extended).get(key)  # type: ignore[no-any-return]


def as_steps(batch: TensorDictBase, inputs: NetworkInputs, *keys: Key) -> TensorDictBase:
    """Sequences [N] as a batch [N, L] that recurrent modules and TorchRL's losses read.

    Args:
        batch: sequences [N] of ``ArcadeCollector.collect()``, or rows of them; a stock batch [B, T]
            is given back.
        inputs: of the networks that will read it.
        *keys: further entries to keep.

    Returns:
        TensorDict [N, L]; the recurrent state counts at index 0 and where an episode begins.
    """
    if is_stock(batch):
        _check_stored_states(batch, inputs)
        return batch
    entries = {key: _get(batch, key) for key in (*inputs.observation_keys, *keys)}
    out = TensorDict(entries, batch_size=_flat(batch, "is_init").shape)
    if inputs.state_keys:
        _begin_with(out, batch["initial_state"], inputs)
    return out


def _check_stored_states(batch: TensorDictBase, inputs: NetworkInputs) -> None:
    """Refuse a stock batch whose sampler cut episodes (``is_init`` in mid-episode) if states stored
    there get lost.
    """
    if inputs.reads_first_state_only and "step_count" in batch:
        within = batch["is_init"].reshape(batch.shape) & (
            batch["step_count"].reshape(batch.shape) > 0
        )
        lost = any(bool(batch[key][within].any()) for key in inputs.state_keys if key in batch)
        if lost:
            raise ValueError(
                "store must be 'step' (of the network) for slices that begin within episodes; got "
                "'sequence'"
            )


def _with_state(
    step: TensorDictBase, state: TensorDictBase | None, inputs: NetworkInputs
) -> TensorDictBase:
    """A step [B] that goes on from a state [B]; memories that store every step load what is stored
    at a start.
    """
    step = step.copy()
    if state is not None and not inputs.reads_first_state_only and "is_init" in step:
        stored = state.clone().zero_().update(step.select(*inputs.state_keys, strict=False))
        state = stored.where(step["is_init"].squeeze(-1), state)
        step["is_init"] = torch.zeros_like(step["is_init"])  # which would drop what was loaded
    return step if state is None else step.update(state)


def _begin_with(sequences: TensorDictBase, state: TensorDictBase, inputs: NetworkInputs) -> None:
    """Let sequences [B, T] begin with states [B]; states that are stored later on stay, others are
    zero.
    """
    for key in inputs.state_keys:
        first = state.get(key)
        every = first.unsqueeze(1).expand(-1, sequences.shape[1], *first.shape[1:])  # a view
        if not inputs.reads_first_state_only:
            stored = sequences.get(key, torch.zeros_like(every))
            every = torch.cat((every[:, :1], stored[:, 1:]), dim=1)
        sequences[key] = every


def _final_places(batch: TensorDictBase, needed: Tensor) -> tuple[Tensor, Tensor]:
    """Steps [N, K] whose next observation is at hand, and which of these places are needed."""
    index = batch.get("final_index", None)
    if index is None:
        count = max(int(needed.sum(1).max()), 1)  # a stock batch has as many places as it needs
        index = (~needed).to(torch.uint8).argsort(dim=1, stable=True)[:, :count]
    used = needed.gather(1, index) & batch.get("final_mask", needed.new_ones(()))
    missing = int(needed.sum() - used.sum())
    if missing:
        raise ValueError(
            "next observations must be stored where needed: collect with final_frames='truncated' "
            "or 'all', "
            f"or take time_limit='terminal'; got {missing} missing"
        )
    return index, used


def _next(batch: TensorDictBase, key: Key, index: Tensor, inputs: NetworkInputs) -> Tensor:
    """The entry of the observations [N, K] behind the steps ``index``; nothing begins there, so no
    state is read.
    """
    if key == "is_init":
        return torch.zeros_like(index, dtype=torch.bool).unsqueeze(-1)
    if key == "pixels" and "final_pixels" in batch:
        return batch["final_pixels"]  # type: ignore[no-any-return]
    other = "action" if key == "last_action" else key if key in inputs.state_keys else None
    value = batch.get(unravel_key(("next", key)), other and batch.get(other, None))
    if value is None:
        raise KeyError(
            f"no next observations: neither 'final_pixels' nor ('next', {key!r}); take collect() "
            "or 'all'"
        )
    return _rows(value, index)


def _add_state(out: TensorDict, batch: TensorDictBase, inputs: NetworkInputs, burn_in: int) -> None:
    """The recurrent state before the first step."""
    first = batch.get("initial_state", None)
    if first is not None:
        out["initial_state"] = first.select(*inputs.state_keys)
        if burn_in and not inputs.reads_first_state_only:
            _begin_with(out["burn_in"], first, inputs)
    elif not (missing := [key for key in inputs.state_keys if key not in batch]):
        out["initial_state"] = TensorDict(
            {key: batch[key][:, 0] for key in inputs.state_keys}, out.batch_size
        )
    elif not bool(batch["is_init"][:, 0].all()):
        raise ValueError(
            f"the batch begins in mid-episode but has neither 'initial_state' nor {missing[0]!r}"
        )


def _rows(value: Tensor, index: Tensor) -> Tensor:
    """Entries [N, K, ...] of [N, L, ...] at the steps ``index`` [N, K]."""
    first = torch.arange(len(index), device=index.device).unsqueeze(1) * value.shape[1]
    return (
        value.flatten(0, 1)
        .index_select(0, (index + first).flatten())
        .view(*index.shape, *value.shape[2:])
    )


def _get(batch: TensorDictBase, key: Key) -> Tensor:
    value = batch.get(key, None)
    if value is None:
        raise KeyError(f"the batch has no entry {key!r}")
    return value  # type: ignore[no-any-return]


def _flat(batch: TensorDictBase, key: Key) -> Tensor:
    """An entry [N, L] or [N, L, 1] as [N, L]."""
    value = _get(batch, key)
    return value.squeeze(-1) if value.ndim == 3 else value
