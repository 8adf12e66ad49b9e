"""Any env of TorchRL as the measures play it: a batch of episodes, under one set of names."""

from typing import Any

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor

from arcade_torch.agents.checked import require
from arcade_torch.models.generators import kept_generators
from arcade_torch.models.recurrence import Key
from arcade_torch.tools.measures.keys import Keys

keeps_generator = kept_generators()
"""Decorates what plays episodes: envs may draw from torch's own generator, and seed it."""


class EpisodeBatch:
    """Plays an env with any names, with or without a batch size, with categorical or one-hot
    actions.

    Args:
        env: of TorchRL, batch size [] or [N].
        keys: where it has frames, the last action and start flags, and reads actions. If it has no
            last action, that is the action before, zeros at first; if it has no start flags, they
            follow from ``done``.
        most: only so many envs of the batch are played, from the first on; what is compiled for a
            batch then serves fewer, and an env of ours plays the same episode in any batch.

    Attributes:
        size: N, or ``most``.

    Raises:
        ValueError: it has more than one batch dimension or reward, or reads no such action, or one
            that is no single choice.
    """

    def __init__(self, env: Any, keys: Keys, most: int | None = None) -> None:
        shape = list(env.batch_size)
        require(len(shape) < 2, "the batch size of env", shape, "[] or [N]")
        self.env = env
        self.keys = keys
        self.is_batch = bool(shape)
        self._envs = int(shape[0]) if shape else 1
        self.size = min(self._envs, most or self._envs)
        rewards = _keys_of(env, "reward")
        require(len(rewards) == 1, "the rewards of env", rewards, "one: name it reward")
        self._reward = ("next", *_path(rewards[0]))
        self._ends = [("next", *_path(key)) for key in _keys_of(env, "done")]
        spec = _action_spec(env, keys.action)
        _refuse_other_actions(spec, keys.action, self._envs)
        self._one_hot = spec if _is_one_hot(spec) else None
        self._count = getattr(spec, "n", None)  # of actions
        self._action_shape = None if spec is None else spec.shape
        self._root: Any = None

    def reset(self, seed: int) -> TensorDictBase:
        """Begin the episodes of a seed: observations [N] with ``pixels``, ``last_action``,
        ``is_init`` and all that the env gives.
        """
        self.env.set_seed(seed)
        self._root = self.env.reset()
        nothing = torch.zeros(self.size, dtype=torch.int64, device="cpu")
        before = torch.zeros_like(self._encode(nothing))  # no action, one-hot: all zeros
        begins = torch.ones(self.size, 1, dtype=torch.bool, device="cpu")
        return self._observe(before, begins)

    def step(self, action: Tensor) -> tuple[TensorDictBase, Tensor, Tensor]:
        """Take actions int64 [N].

        Returns:
            (the next observations [N], reward float [N, 1], done bool [N]).

        Raises:
            ValueError: the env does not have so many actions.
        """
        if self._count is not None and int(action.max()) >= self._count:
            raise ValueError(
                f"actions must be below {self._count}, the number of the env's, got "
                f"{int(action.max())}: the policy has outputs for more"
            )
        encoded = self._encode(action)
        given = encoded if self.is_batch else encoded[0]
        if self.size < self._envs:
            given = torch.cat([given, given.new_zeros(self._envs - self.size, *given.shape[1:])])
        if self._action_shape is not None:
            given = given.reshape(self._action_shape)
        self._root.set(self.keys.action, given)
        step, self._root = self.env.step_and_maybe_reset(self._root)
        reward = self._one_a_row(step, self._reward)
        ends = [self._one_a_row(step, key) for key in self._ends]
        done = torch.cat(ends, -1).any(-1, keepdim=True)
        return self._observe(encoded, done), reward, done.reshape(-1)

    def _observe(self, last_action: Tensor, is_init: Tensor) -> TensorDictBase:
        """What the env gives, with defaults for what it lacks, under the names of the measures."""
        keys = self.keys
        obs = self._root.copy() if self.is_batch else self._root.unsqueeze(0)
        obs = obs[: self.size] if self.size < self._envs else obs
        pixels = obs.get(keys.pixels, None)
        if pixels is None:
            raise ValueError(
                f"the env must have the frames under {keys.pixels!r}, got "
                f"{sorted(obs.keys(True, True), key=str)}: name pixels_key"
            )
        last_action = obs.get(keys.last_action, last_action)
        is_init = obs.get(keys.is_init, is_init)
        obs.set("pixels", pixels)
        obs.set("last_action", last_action.to(pixels.device))
        obs.set("is_init", is_init.reshape(-1, 1).to(pixels.device))
        return obs

    def _encode(self, action: Tensor) -> Tensor:
        """Actions int64 [N], one-hot [N, A] where the env reads them so."""
        if self._one_hot is None:
            return action
        return one_hot(action, self._one_hot.shape[-1]).to(self._one_hot.dtype)

    def _one_a_row(self, step: TensorDictBase, key: tuple[str, ...]) -> Tensor:
        """An entry of a step, one number or flag for each env, as [N, 1]."""
        value = step[key]
        require(
            value.numel() == self._envs,
            f"the entry {key!r} of env",
            list(value.shape),
            f"one number a step, {[*self.env.batch_size, 1]}",
        )
        rows: Tensor = value.reshape(self._envs, 1)
        return rows[: self.size]


def one_hot(action: Tensor, count: int) -> Tensor:
    """Actions int64 [...] as one-hot int64 [..., count]."""
    return torch.nn.functional.one_hot(action, count)


def _keys_of(env: Any, name: str) -> list[Key]:
    """Where an env has its reward, or says that an episode is done: under the usual name, else
    under all that its specs say.
    """
    keys: list[Key] = [unravel_key(key) for key in getattr(env, f"{name}_keys", [])]
    return [name] if name in keys or not keys else keys


def _path(key: Key) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def _action_spec(env: Any, key: Key) -> Any:
    """The spec of an env's action; None for an env without specs."""
    specs = getattr(env, "full_action_spec", None)
    if specs is None:
        return None
    keys = list(specs.keys(True, True))
    require(key in keys, "the action of env", keys, f"under {key!r}, or be named with action_key")
    return specs[key]


def _refuse_other_actions(spec: Any, key: Key, envs: int) -> None:
    """Refuse actions that are no choice of one among several: the measures compare choices."""
    # imported here: who measures windows of their own needs no TorchRL
    from torchrl.data import MultiCategorical, MultiOneHot

    if spec is None:
        return
    is_one = not isinstance(spec, MultiCategorical | MultiOneHot)
    if not _is_one_hot(spec):
        is_one = is_one and not spec.dtype.is_floating_point and spec.shape.numel() == envs
    words = f"{type(spec).__name__} of {spec.dtype} {list(spec.shape)}"
    require(is_one, f"the action {key!r} of env", words, "one choice, Categorical or OneHot")


def _is_one_hot(spec: Any) -> bool:
    # imported here: who measures windows of their own needs no TorchRL
    from torchrl.data import OneHot

    return isinstance(spec, OneHot)
