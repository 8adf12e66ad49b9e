"""What a network reads of a batch, which layout that has, and what no loss can read."""

from typing import Any

from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import GRUModule, LSTMModule

from arcade_torch.agents.checked import require
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.models.memory_module import MemoryModule
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.rollout_buffer import final_key

Key = str | tuple[str, ...]


class NetworkInputs:
    """Which entries of a batch a TensorDict module reads; a key that it also writes under "next" is
    recurrent state.
    """

    def __init__(self, network: TensorDictModuleBase) -> None:
        check_module(network)
        check_state_keys(network)
        keys = [unravel_key(key) for key in network.in_keys]
        outputs = {unravel_key(key) for key in network.out_keys}
        self.state_keys = [key for key in keys if unravel_key(("next", key)) in outputs]
        self.observation_keys = [key for key in keys if key not in self.state_keys]
        self.final_keys = {key: final_key(key) for key in keys}
        self.stores = set()
        self.start_keys: set[Key] = {"is_init"}
        for module in network.modules():
            if isinstance(module, MemoryModule | MemoryNetwork):
                self.stores.add(module.store)
                self.start_keys.add(module.recurrence.is_init_key)
        self.reads_first_state_only = self.stores == {"sequence"}
        self.loads_at_starts = loads_at_starts(network)


def entry(batch: TensorDictBase, key: Key) -> Tensor:
    """An entry of a batch; a KeyError that names it if it is not there."""
    value = batch.get(key, None)
    if value is None:
        raise KeyError(f"the batch has no entry {key!r}")
    return value  # type: ignore[no-any-return]


def flat(batch: TensorDictBase, key: Key) -> Tensor:
    """An entry [N, L] or [N, L, 1] as [N, L]."""
    value = entry(batch, key)
    return value.squeeze(-1) if value.ndim == 3 else value


def is_stock(batch: TensorDictBase, is_init: Key = "is_init") -> bool:
    """Whether a batch has TorchRL's layout [..., L], not that of sequences [N] with entries [N, L,
    ...]; refuse one without a step, or whose time is not its last dimension (ValueError).
    """
    flags = entry(batch, is_init)
    if batch.ndim == 0 or flags.numel() == 0:
        raise ValueError(
            f"a batch must be [..., L] with L >= 1 steps; got batch_size {list(batch.shape)}"
        )
    names = batch.names if batch.ndim > 1 else ["time"]
    if "time" in names and names[-1] != "time":
        raise ValueError(
            f"time must be the last dimension of a batch, [..., L]: transpose it; got {names}"
        )
    return batch.ndim != 1 or flags.shape == (*batch.shape, 1)


def is_prepared(batch: TensorDictBase) -> bool:
    """Whether a batch is what ``insert_final_observations`` gave; an observation may be called as
    an entry of that.
    """
    return isinstance(batch.get("extended", None), TensorDictBase) and "position" in batch


def with_mask(batch: TensorDictBase, mask: Tensor | None) -> TensorDictBase:
    """The batch with its mask, bool [*, L], where TorchRL's losses look for one."""
    if mask is None:
        return batch
    batch = batch.copy()
    batch["collector", "mask"] = mask.unsqueeze(-1)
    return batch


def one_a_step(name: Key, value: Tensor, steps: TensorDictBase) -> Tensor:
    """A number a step, [*, L] or [*, L, 1], as [*, L, 1]; refuse any other shape (ValueError),
    which would be spread over the batch.
    """
    shape = (*steps.shape, 1)
    fits = value.shape in (steps.shape, shape)
    require(fits, f"the shape of {name!r}", list(value.shape), f"{list(shape)}, one number a step")
    return value.reshape(shape)


def stored_numbers(
    steps: TensorDictBase, keys: tuple[Key, ...], mask: Tensor | None
) -> dict[Key, Tensor]:
    """What was stored of every step, [*, L, 1], without gradient; 0 where there is padding."""
    numbers = {}
    for key in keys:
        number = one_a_step(key, steps[key].detach(), steps)
        numbers[key] = number if mask is None else number.where(mask.unsqueeze(-1), 0)
    return numbers


def check_module(network: Any) -> None:
    """Refuse a network that is no TensorDict module (TypeError)."""
    if not hasattr(network, "in_keys") or not hasattr(network, "out_keys"):
        raise TypeError(
            f"a network must be a TensorDict module; got {kind_of(network)}: "
            "TensorDictModule(network, [what it reads], [what it writes])"
        )


def written(steps: TensorDictBase, key: Key, network: TensorDictModuleBase) -> Tensor:
    """What a network has written under a key; a KeyError if it has not."""
    value = steps.get(key, None)
    if value is None:
        raise KeyError(
            f"the network does not write {key!r}, it writes {list(network.out_keys)}: name the "
            "entry with set_keys, or let it write that"
        )
    return value  # type: ignore[no-any-return]


def loads_at_starts(network: TensorDictModuleBase) -> bool:
    """Whether all memories known here read, in a pass over time, the state that is given where an
    episode begins; as they act they drop it.
    """
    loads = set()
    for module in network.modules():
        if isinstance(module, MemoryModule | MemoryNetwork):
            loads.add(module.store == "step")
        elif isinstance(module, LSTMModule | GRUModule):
            loads.add(True)
    return loads == {True}


def check_state_keys(network: TensorDictModuleBase) -> None:
    """Refuse two memories that have their state under one key (ValueError): each would read what
    the other has written. One memory in two networks is none of these.
    """
    owners = dict[Any, Any]()
    for module in network.modules():
        if isinstance(module, MemoryModule):
            owner = module.memory
        elif isinstance(module, MemoryNetwork):
            owner = module.block
        elif isinstance(module, LSTMModule | GRUModule):
            owner = module
        else:
            continue
        written = {unravel_key(key) for key in module.out_keys}
        for key in map(unravel_key, module.in_keys):
            if unravel_key(("next", key)) in written and owners.setdefault(key, owner) is not owner:
                raise ValueError(
                    f"state_key must be another for each memory of the networks; got two with "
                    f"their state under {key!r}"
                )


def check_order(batch: TensorDictBase, cut: Tensor, mask: Tensor | None, has_memory: bool) -> None:
    """Refuse a stock batch of shuffled steps, or one in which a memory would read on from one
    episode into the next (ValueError).

    Args:
        batch: [N] with entries [N, L, ...].
        cut: bool [N, L], steps behind which an episode or its record ends.
        mask: bool [N, L], steps that are no padding.
        has_memory: whether the networks have one.
    """
    if "final_index" in batch:
        return
    ends = cut[:, :-1]
    begins = flat(batch, "is_init")[:, 1:]
    if mask is not None:
        padding = ~mask
        ends = ends | padding[:, :-1]
        begins = begins | padding[:, :-1] | padding[:, 1:]
    follows = {}
    if "step_count" in batch and ("next", "step_count") in batch:
        after = flat(batch, ("next", "step_count"))
        follows["step_count"] = after[:, :-1] == flat(batch, "step_count")[:, 1:]
    trajectory = ("collector", "traj_ids")
    if trajectory in batch:  # steps of two envs may be counted as if they were of one
        numbers = flat(batch, trajectory)
        follows["('collector', 'traj_ids')"] = numbers[:, :-1] == numbers[:, 1:]
    for name, same in follows.items():
        if not bool((ends | same).all()):
            raise ValueError(
                f"{name} must be that of whole sequences, never shuffled; got a jump within a row"
            )
        if has_memory and not bool((begins | same).all()):
            raise ValueError(
                "is_init must be true where an episode begins; got false behind an end, where "
                f"{name} jumps: put InitTracker() behind NoopResetEnv, and leave "
                "break_when_all_done out of rollout, which repeats last steps"
            )


def check_stored_states(batch: TensorDictBase, inputs: NetworkInputs) -> None:
    """Refuse a stock batch whose sampler cut episodes (``is_init`` in mid-episode) if states stored
    there get lost (ValueError).
    """
    if not inputs.reads_first_state_only or "step_count" not in batch:
        return
    is_init = batch["is_init"].reshape(batch.shape).bool()
    within_episode = batch["step_count"].reshape(batch.shape) > 0
    for key in inputs.state_keys:
        if key in batch and bool(batch[key][is_init & within_episode].any()):
            raise ValueError(
                "store must be 'step' (of the network) for slices that begin within episodes; got "
                "'sequence'"
            )
