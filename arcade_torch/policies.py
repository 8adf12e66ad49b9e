"""What acts in a collector: our ``Actor`` protocol, TorchRL modules behind it, and a random player."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import nn
from torchrl.envs import TensorDictPrimer
from torchrl.modules.utils import get_primers_from_module

Extras = dict[NestedKey, torch.Tensor]
ROOT_KEYS = ("pixels", "last_action", "is_init", "step_count", "episode_reward", "task")  # task: if there are several


@runtime_checkable
class Actor(Protocol):
    """Something that acts on a batch of envs and owns no state: the recurrent state goes in and comes out.

    An actor may have an attribute ``obs_keys``, the root keys that it reads; the collector saves itself the others.
    """

    def initial_state(self, batch_size: int) -> TensorDict:
        """The recurrent state before the first step: TensorDict [batch_size]."""
        ...

    def act(self, obs: TensorDict, state: TensorDict) -> tuple[torch.Tensor, Extras, TensorDict]:
        """Choose actions.

        Args:
            obs: TensorDict [N], the root: pixels, last_action, is_init, step_count, episode_reward, and task where
                several games are played. Where ``is_init`` is true the actor has to begin from a fresh state.
            state: TensorDict [N], the state that the last call returned. Not to be changed in place.

        Returns:
            Actions int64 [N], further tensors [N, ...] worth storing, and the state after this step.
        """
        ...


class RandomActor:
    """Uniformly random actions, from a generator of its own.

    Args:
        num_actions: Number of actions.
        generator: Where the random numbers come from.
    """

    obs_keys: tuple[str, ...] = ()

    def __init__(self, num_actions: int, generator: torch.Generator) -> None:
        self._num_actions = num_actions
        self._generator = generator

    def initial_state(self, batch_size: int) -> TensorDict:
        """No state."""
        return TensorDict({}, batch_size=[batch_size])

    def act(self, obs: TensorDict, state: TensorDict) -> tuple[torch.Tensor, Extras, TensorDict]:
        """Draw actions; see ``Actor``."""
        return self.draw(obs.batch_size[0]), {}, state

    def draw(self, num_envs: int) -> torch.Tensor:
        """Actions int64 [num_envs]."""
        return torch.randint(self._num_actions, (num_envs,), generator=self._generator, device=self._generator.device)


class ModuleActor:
    """A TorchRL policy as an ``Actor``.

    What the policy writes under ``"next"`` is carried to the root of the following step; at the start of an episode it
    is put back to the value of the policy's primer (zero, as a rule), as ``TensorDictPrimer`` does. Everything else
    that the policy writes beside the action is stored, and so are the carried entries unless ``store_states`` is off.

    Args:
        policy: Reads root keys, writes ``action`` and, if it is recurrent, ``("next", <state key>)``.
        store_states: Whether the carried entries are stored for every step, as TorchRL's losses and samplers expect.
        device: Device of the state.
    """

    def __init__(
        self, policy: Callable[[TensorDictBase], TensorDictBase], store_states: bool, device: torch.device | None
    ) -> None:
        self._policy = policy
        self._store_states = store_states
        self._device = device
        self._first: TensorDict | None = None
        reads = getattr(policy, "in_keys", ROOT_KEYS)
        self.obs_keys = tuple(key for key in ROOT_KEYS if key in reads or key == "is_init")

    def initial_state(self, batch_size: int) -> TensorDict:
        """Values of the policy's primers, TensorDict [batch_size].

        Raises:
            KeyError: The policy carries an entry from step to step for which it has no primer.
        """
        state = TensorDict({}, batch_size=[batch_size], device=self._device)
        for primer in _primers(self._policy):
            for key, spec in primer.primers.items(True, True):
                default = primer.default_value.get(key, 0.0) if hasattr(primer.default_value, "get") else 0.0
                shape = spec.shape[len(primer.primers.shape) :]
                zeros = torch.zeros((batch_size, *shape), dtype=spec.dtype, device=self._device)
                state[key] = (zeros + (default() if callable(default) else default)).to(spec.dtype)
        self._check_primed(state)
        self._first = state
        return state.clone()

    def act(self, obs: TensorDict, state: TensorDict) -> tuple[torch.Tensor, Extras, TensorDict]:
        """Run the policy; see ``Actor``."""
        is_init = obs["is_init"].squeeze(-1)
        if len(state.keys()) and bool(is_init.any()):
            state = self._begin_anew(state, is_init)
        td = TensorDict({**dict(obs.items()), **dict(state.items())}, batch_size=obs.batch_size, device=self._device)
        td = self._policy(td)
        following = td.get("next", None)
        carried = TensorDict({}, batch_size=obs.batch_size, device=self._device)
        extras: Extras = {}
        for key in [] if following is None else list(following.keys(True, True)):
            carried[key] = following[key]
            if self._store_states:
                extras["next", *(key if isinstance(key, tuple) else (key,))] = following[key]
        for key in td.keys(True, True):
            first = key[0] if isinstance(key, tuple) else key
            if first not in ROOT_KEYS and first not in ("action", "next"):
                is_state = key in state.keys(True, True)
                if self._store_states or not is_state:
                    extras[key] = td[key]
        return td["action"], extras, carried

    def _check_primed(self, state: TensorDict) -> None:
        """Refuse a policy that carries what nobody can start."""
        written = [unravel_key(key) for key in getattr(self._policy, "out_keys", [])]
        for key in getattr(self._policy, "in_keys", []):
            if unravel_key(("next", key)) in written and key not in state.keys(True, True):
                raise KeyError(
                    f"the policy reads {key!r} and writes it for the next step, but has no primer that says how it "
                    f"begins: give the module a method make_tensordict_primer()"
                )

    def _begin_anew(self, state: TensorDict, is_init: torch.Tensor) -> TensorDict:
        """Put the initial state where an episode begins."""
        fresh = TensorDict({}, batch_size=state.batch_size, device=self._device)
        for key in state.keys(True, True):
            value = state[key]
            first = self._first.get(key, None) if self._first is not None else None
            mask = is_init.reshape(is_init.shape + (1,) * (value.ndim - 1))
            fresh[key] = torch.where(mask, torch.zeros_like(value) if first is None else first, value)
        return fresh


def _primers(policy: Any) -> list[TensorDictPrimer]:
    """The primers of all modules inside a policy."""
    if not isinstance(policy, nn.Module):
        return []
    found = get_primers_from_module(policy, warn=False)
    if found is None:
        return []
    return [found] if isinstance(found, TensorDictPrimer) else list(found)
