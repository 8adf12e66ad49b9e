"""A TorchRL policy inside the collector: what it reads, the recurrent state it carries, what is
stored of it.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, NoReturn

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import nn
from torchrl.data import Bounded, Categorical, TensorSpec
from torchrl.envs import TensorDictPrimer
from torchrl.modules.utils import get_primers_from_module

from arcade_torch.envs_jax.validation import kind_of

Policy = Callable[[TensorDictBase], TensorDictBase]
# beside the observation; task: if there are several
ROOT_KEYS = ("last_action", "is_init", "step_count", "episode_reward", "task")
ENDS = ("done", "terminated", "truncated")
"""False at every root, for an episode that has ended begins anew; for policies that read them."""


class PolicyRunner:
    """Runs a policy, and carries what it writes under ``"next"`` to the root of the following step.
    What it writes to the root is there at the following step too, as in TorchRL's collectors: noise
    that goes on from step to step, plans of several actions.

    Args:
        policy: Reads root keys, writes ``action`` and, if recurrent, ``("next", <state key>)``;
            None writes nothing.
        batch_size: N.
        device: Device of the state.
        observation_keys: Root keys of the env's observation.
        store: Keys to store (a prefix stands for all below it); None for everything the policy
            writes.
        store_states: Whether the recurrent state of every step may be stored.
    """

    def __init__(
        self,
        policy: Policy | None,
        batch_size: int,
        device: torch.device,
        observation_keys: Iterable[NestedKey],
        store: Iterable[NestedKey] | None,
        store_states: bool,
    ) -> None:
        self._policy = policy
        self._size = [batch_size]
        self._device = device
        self._store = None if store is None else [path_of(key) for key in store]
        self._store_states = store_states
        root_keys = (*observation_keys, *ROOT_KEYS)
        reads = () if policy is None else getattr(policy, "in_keys", root_keys)
        prefixes = [path_of(key) for key in reads] + [("is_init",)]
        self.reads = tuple(key for key in root_keys if _is_below(path_of(key), prefixes))
        self._ends = {}
        if policy is not None:
            no = torch.zeros(batch_size, 1, dtype=torch.bool, device=device)
            self._ends = {key: no for key in ENDS if key in getattr(policy, "in_keys", ENDS)}
        # what is never stored as something that the policy wrote
        self._known = {path_of(key)[0] for key in root_keys} | {"action", *ENDS}
        # what the env writes under "next", whatever a policy has written there
        self._outcomes = {path_of(key) for key in (*root_keys, "reward", *ENDS)}
        # states of modules that begin anew by themselves
        self._self_resetting: set[NestedKey] = set()
        self._initial = TensorDict({}, batch_size=self._size, device=device)
        # whether the primers give other values for every episode
        self._start_is_drawn = False
        # what the policy wrote to the root at the last step
        self._root_outputs: dict[NestedKey, torch.Tensor] = {}
        self._shows_root_outputs = not _takes_one_layout(policy)

    def initial_state(self) -> TensorDict:
        """Values of the policy's primers, TensorDict [N]; what the policy wrote is forgotten.

        Raises:
            KeyError: The policy carries an entry from step to step for which it has no primer.
        """
        self._root_outputs = {}
        self._start_is_drawn = any(map(_is_drawn, _primers(self._policy)))
        if not self._store_states:  # stored ones show what a module begins with
            self._self_resetting = _self_resetting(self._policy)
        state = self._first_values()
        written = [unravel_key(key) for key in getattr(self._policy, "out_keys", [])]
        for key in getattr(self._policy, "in_keys", []):
            is_carried = (
                unravel_key(("next", key)) in written and path_of(key) not in self._outcomes
            )
            if is_carried and key not in state.keys(True, True):
                raise KeyError(
                    f"the policy reads {key!r} and writes it for the next step, but has no primer "
                    "that says how it begins: give the module a method make_tensordict_primer()"
                )
        self._initial = state
        return state.clone()

    def _first_values(self) -> TensorDict:
        """The state that episodes begin with, TensorDict [N]."""
        state = TensorDict({}, batch_size=self._size, device=self._device)
        for primer in _primers(self._policy):
            for key, value in _values(primer, self._size, self._device):
                state[key] = value
        return state

    def begin_anew(
        self, state: TensorDict, is_init: torch.Tensor, but: Collection[NestedKey] = ()
    ) -> TensorDict:
        """The state with the primers' values where ``is_init`` (bool [N, 1]) is true, ``but`` for
        the entries that stay; a new TensorDict.
        """
        out = TensorDict({}, batch_size=self._size, device=self._device)
        for key, value in state.items(True, True):
            first = None if key in but else self._initial.get(key, None)
            mask = is_init.reshape(-1, *(1,) * (value.ndim - 1))
            out[key] = value if first is None else torch.where(mask, first, value)
        return out

    def __call__(
        self, obs: dict[NestedKey, torch.Tensor], state: TensorDict
    ) -> tuple[torch.Tensor | None, dict[NestedKey, torch.Tensor], TensorDict]:
        """Run one step from root entries and the state that the last call returned.

        Returns:
            Actions int64 [N] (None without a policy), the entries to store [N, ...], the state
            after this step.
        """
        if self._policy is None:
            return None, {}, state
        if set(state.keys(True, True)) - self._self_resetting:
            state = self.begin_anew(state, obs["is_init"], self._self_resetting)
        # the same at every step: graphs hold one layout
        entries = {key: obs[key] for key in self.reads if key in obs} | self._ends
        entries = self._root_outputs | entries | dict(state.items())
        td = TensorDict(entries, batch_size=self._size, device=self._device)
        td = self._policy(td)
        if not isinstance(td, TensorDictBase) or "action" not in td:
            _refuse_output(td)
        stored, carried = self._take_apart(td, state)
        if self._start_is_drawn and obs["is_init"].any():
            self._initial = self._first_values()
        return td["action"], stored, carried

    def _take_apart(
        self, td: TensorDictBase, state: TensorDict
    ) -> tuple[dict[NestedKey, torch.Tensor], TensorDict]:
        """The entries of a policy's output that are stored, and the state after the step; what else
        it wrote to the root is kept for its next step.
        """
        stored: dict[NestedKey, torch.Tensor] = {}
        root_outputs: dict[NestedKey, torch.Tensor] = {}
        carried = TensorDict({}, batch_size=self._size, device=self._device)
        for key, value in state.items(True, True):
            carried[key] = td.get(key, value)  # unless the policy writes another for the next step
        states = set(map(path_of, state.keys(True, True)))
        for key, value in td.items(True, True):
            path = path_of(key)
            if path[0] == "next" and path[1:] in self._outcomes:
                continue
            if path[0] == "next":
                carried[path[1:]] = value
            is_state = path[0] == "next" or path in states
            is_own = path[0] not in self._known
            if not is_state and (is_own or path == ("action",)):
                root_outputs[key] = value
            if is_own and self._keeps(path, is_state):
                stored[key] = value
        self._root_outputs = root_outputs if self._shows_root_outputs else {}
        return stored, carried

    def show_action(self, action: torch.Tensor) -> None:
        """Put the action that was taken in the place of the policy's."""
        if "action" in self._root_outputs:
            self._root_outputs["action"] = action

    def root_outputs(self) -> dict[str, Any]:
        """What the policy wrote to the root at the last step, as plain tensors."""
        outputs = TensorDict(self._root_outputs, batch_size=self._size)
        return outputs.clone().to_dict()  # type: ignore[no-any-return]

    def load_root_outputs(self, state: dict[str, Any]) -> None:
        """Load what ``root_outputs`` gave."""
        outputs = TensorDict(state, batch_size=self._size, device=self._device)
        self._root_outputs = dict(outputs.items(True, True))

    def _keeps(self, path: tuple[str, ...], is_state: bool) -> bool:
        """Whether an entry is stored: private ones if they are asked for, as in TorchRL's
        collectors.
        """
        if is_state and not self._store_states:
            return False
        if self._store is None:
            return is_state or not any(name.startswith("_") for name in path)
        return _is_below(path, self._store)


def _refuse_output(given: Any) -> NoReturn:
    """Say what a policy has to give in the place of what it gave."""
    kind = kind_of(given)
    if isinstance(given, TensorDictBase):
        kind = f"{', '.join(map(str, given.keys()))}, but no 'action'"
    raise TypeError(
        f"the policy gives {kind}, expected the TensorDict that it was called with, and in it "
        "'action'; a module of tensors goes as TensorDictModule(module, ['pixels'], ['action'])"
    )


def _is_below(path: tuple[str, ...], prefixes: Iterable[tuple[str, ...]]) -> bool:
    """Whether a key is one of some, or stands below one."""
    return any(path[: len(prefix)] == prefix for prefix in prefixes)


def random_actions(spec: TensorSpec, generator: torch.Generator) -> torch.Tensor:
    """Actions of all envs: any integer that is allowed, numbers between the bounds, and numbers of
    mean 0 and deviation 1 where there are none.
    """
    shape = spec.shape
    device = spec.device
    if isinstance(spec, Categorical):
        return torch.randint(spec.space.n, shape, generator=generator, device=device)
    if not isinstance(spec, Bounded):
        return torch.randn(shape, generator=generator, device=device, dtype=spec.dtype)
    # the distance of two numbers of a type may be too large for the type
    low: torch.Tensor = spec.space.low.to(torch.float64)
    distance: torch.Tensor = spec.space.high.to(torch.float64) - low
    if not spec.dtype.is_floating_point:
        share = torch.rand(shape, generator=generator, device=device, dtype=torch.float64)
        return (low + (share * (distance + 1)).floor()).to(spec.dtype)
    share = torch.rand(shape, generator=generator, device=device, dtype=spec.dtype)
    return (low + share * distance).to(spec.dtype)


def copy_weights(policy: nn.Module, given: nn.Module | TensorDictBase | Mapping[str, Any]) -> None:
    """Copy weights into a policy by name.

    TorchRL's trainers hand over those of the actor alone. What is a tensor of the policy already,
    under whatever name, acts as it is.

    Raises:
        ValueError: A weight that the policy does not have; nothing is copied.
    """
    weights = _weights(policy)
    acting = {(weight.data_ptr(), weight.shape) for weight in weights.values()}
    others = {}
    for name, value in _weights(given).items():
        if (value.data_ptr(), value.shape) in acting:
            continue
        if name not in weights or weights[name].shape != value.shape:
            raise ValueError(
                f"the weights have {name} {list(value.shape)}, which the policy does not: give "
                "those of the whole policy, TensorDict.from_module(policy)"
            )
        others[name] = value
    for name, value in others.items():
        weights[name].copy_(value)


def _weights(given: nn.Module | TensorDictBase | Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Parameters and buffers by name, as ``state_dict`` calls them."""
    if isinstance(given, nn.Module):
        given = TensorDict.from_module(given)
    if isinstance(given, TensorDictBase):
        given = given.flatten_keys(".")
    tensors = {}
    for name, value in given.items():
        if isinstance(value, torch.Tensor):
            # torch.compile puts a module into another one
            tensors[name.removeprefix("_orig_mod.")] = value.data
    return tensors


def path_of(key: NestedKey) -> tuple[str, ...]:
    """A key as a tuple."""
    return (key,) if isinstance(key, str) else key


def _module_of(policy: Any) -> nn.Module:
    """The module that a policy is; ``CudaGraphModule`` is none itself, but holds one. An empty one
    of a function.
    """
    module = policy if isinstance(policy, nn.Module) else getattr(policy, "module", None)
    return module if isinstance(module, nn.Module) else nn.Module()


def _takes_one_layout(policy: Any) -> bool:
    """Whether a policy is a CUDA graph, which takes the same entries at every step: one of ours, or
    ``CudaGraphModule``.
    """
    is_graph_module = hasattr(policy, "module") and not isinstance(policy, nn.Module)
    return is_graph_module or getattr(policy, "takes_one_layout", False)


def _primers(policy: Any) -> list[TensorDictPrimer]:
    """The primers of all modules inside a policy."""
    primers = get_primers_from_module(_module_of(policy), warn=False)
    if primers is None:
        return []
    return [primers] if isinstance(primers, TensorDictPrimer) else list(primers)


def _self_resetting(policy: Any) -> set[NestedKey]:
    """The states of the modules that read ``is_init``, where they begin anew."""
    keys = set[NestedKey]()
    for module in _module_of(policy).modules():
        make_primer: Any = getattr(module, "make_tensordict_primer", None)
        if make_primer is not None and "is_init" in getattr(module, "in_keys", ()):
            keys.update(make_primer().primers.keys(True, True))
    return keys


def check_state_keys(policy: Any) -> None:
    """Refuse two memories that have their state under one key (ValueError): each would read what
    the other has written. Modules that share weights are one memory.
    """
    owners: dict[Any, set[nn.Parameter]] = {}
    for module in _module_of(policy).modules():
        weights = set(module.parameters())
        if not weights or not hasattr(module, "make_tensordict_primer"):
            continue
        written = {unravel_key(key) for key in getattr(module, "out_keys", ())}
        for key in map(unravel_key, getattr(module, "in_keys", ())):
            if unravel_key(("next", key)) not in written:
                continue
            if weights.isdisjoint(owners.setdefault(key, weights)):
                raise ValueError(
                    f"state_key must be another for each memory of a policy; got two with their "
                    f"state under {key!r}"
                )


def _is_drawn(primer: TensorDictPrimer) -> bool:
    """Whether a primer gives other values for every episode."""
    given = primer.default_value
    if primer.random or callable(given):
        return True
    return any(callable(given[key]) for key in primer.primers.keys(True, True))


def _values(
    primer: TensorDictPrimer, size: list[int], device: torch.device
) -> Iterator[tuple[NestedKey, torch.Tensor]]:
    """What a primer puts at the beginning of an episode: keys and values [N, ...]."""
    given = primer.default_value
    if callable(given):
        given = given(reset=torch.ones(size, dtype=torch.bool, device=device))
    for key, spec in primer.primers.items(True, True):
        shape = (*size, *spec.shape[len(primer.primers.shape) :])
        if primer.random:
            drawn = spec.rand() if spec.shape == shape else spec.expand(shape).rand()
            yield key, drawn.to(device)
            continue
        value: Any = given[key]
        value = value() if callable(value) else value
        zeros = torch.zeros(shape, dtype=spec.dtype, device=device)
        yield key, zeros + torch.as_tensor(value, dtype=spec.dtype, device=device)
