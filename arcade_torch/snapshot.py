"""Snapshots: everything a batch of episodes is, as a TensorDict that can be stored, cloned, indexed
and loaded.

Leaves are private copies, never views of live JAX memory. Random keys (uint32) travel as int32 of
the same bits, since tensordict has no arithmetic for unsigned integers; so do keys of
``jax.random.key`` and bfloat16, which torch does not know from NumPy.
"""

import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, Unbounded

from arcade_torch.devices import wait_for_torch
from arcade_torch.dlpack import to_torch
from arcade_torch.envs_jax import registered_ids
from arcade_torch.envs_jax.batch import Batch, BatchedGame
from arcade_torch.envs_jax.settings import is_key
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.validation import check_tensor

# flags that snapshots of version 0.2.0 lack: no episode of theirs has ended
_ENDS = ("terminated", "truncated")
_SIGNED = {np.dtype(np.uint32): torch.int32, np.dtype(np.uint16): torch.int16}


def fingerprint(game_id: str) -> int:
    """A number for a game id, so that a snapshot can tell which game it belongs to: its CRC-32."""
    return zlib.crc32(game_id.encode())


def _torch_dtype(dtype: np.dtype[Any]) -> torch.dtype:
    return torch.from_numpy(np.empty(0, dtype)).dtype


def _bits(leaf: Any) -> Any:
    """The bits of keys of ``jax.random.key``, and of floats that NumPy lacks, such as bfloat16;
    int4 and its like as int8; other arrays as they are.
    """
    if is_key(leaf):
        return jax.random.key_data(leaf)
    if np.dtype(leaf.dtype).kind != "V":
        return leaf
    if _is_short(leaf.dtype):
        return leaf.astype(jnp.int8)
    return jax.lax.bitcast_convert_type(leaf, f"uint{8 * np.dtype(leaf.dtype).itemsize}")


def _is_short(dtype: Any) -> bool:
    """Whether these are whole numbers of less than a byte, as int4."""
    return jnp.issubdtype(dtype, jnp.integer) and jnp.iinfo(dtype).bits < 8


def _typed(array: jax.Array, leaf: Any) -> jax.Array:
    """The inverse of ``_bits``: an array of the type of ``leaf``."""
    if is_key(leaf):
        kinds: list[Any] = []  # JAX tells it of arrays alone
        jax.eval_shape(lambda keys: kinds.append(jax.random.key_impl(keys)), leaf)
        array = jax.random.wrap_key_data(array, impl=kinds[0])
    elif _is_short(leaf.dtype):
        array = array.astype(leaf.dtype)
    elif array.dtype != leaf.dtype:
        array = jax.lax.bitcast_convert_type(array, leaf.dtype)
    return array


def _entry(td: TensorDictBase, path: tuple[str, ...]) -> torch.Tensor:
    """A leaf of a state, or one line about what stands in its place."""
    value: Any = td
    for depth, name in enumerate(path):
        value = value.get(name, None) if isinstance(value, TensorDictBase) else None
        if value is None:
            raise ValueError(
                f"the state has no entry {'.'.join(path[: depth + 1])!r}: pass what get_state() "
                "gave"
            )
    check_tensor(value, f"state entry {'.'.join(path)!r}")
    leaf: torch.Tensor = value
    return leaf


class TreeSnapshots:
    """Turns one pytree of arrays [N, ...] into a TensorDict [N] and back.

    Args:
        tree: Any such tree; shapes and types are taken from it.
        num_envs: N.
        device: Of the tensors.
        jax_device: Of the arrays.
        kind: What the tree is called in messages.
        may_lack: Names of leaves that an older TensorDict lacks; zeros stand in for them.
    """

    def __init__(
        self,
        tree: Any,
        num_envs: int,
        device: torch.device,
        jax_device: jax.Device,
        kind: str,
        may_lack: tuple[str, ...] = (),
    ) -> None:
        leaves, self._tree = jax.tree_util.tree_flatten_with_path(tree)
        self._keys: list[tuple[str, ...]] = []
        self._leaves: list[Any] = []
        self._dtypes: list[np.dtype[Any]] = []
        self._shapes: list[torch.Size] = []
        for path, leaf in leaves:
            self._keys.append(tuple(jax.tree_util.keystr((key,), simple=True) for key in path))
            self._leaves.append(leaf)
            plain = jax.eval_shape(_bits, leaf)
            self._dtypes.append(np.dtype(plain.dtype))
            self._shapes.append(torch.Size(plain.shape))
        self._num_envs = num_envs
        self._device = device
        self._jax_device = jax_device
        self._kind = kind
        self._may_lack = may_lack

    def export(self, tree: Any) -> TensorDict:
        """Copy a tree out of JAX, every leaf under its path."""
        out = TensorDict({}, batch_size=[self._num_envs], device=self._device)
        for key, leaf in zip(self._keys, jax.tree.leaves(tree), strict=True):
            array = _bits(leaf)
            tensor = to_torch(array, self._device)
            signed = _SIGNED.get(np.dtype(array.dtype))
            out[key] = (tensor if signed is None else tensor.view(signed)).clone()
        return out

    def load(self, td: TensorDictBase) -> Any:
        """Copy into JAX what ``export`` gave.

        Raises:
            ValueError: Another batch size, or leaves that are missing, or of another shape or type.
            TypeError: Not a TensorDict, or a leaf that is no tensor.
        """
        self.check_batch(td)
        wait_for_torch(self._device, self._jax_device)
        arrays = []
        columns = (self._keys, self._leaves, self._dtypes, self._shapes)
        for key, leaf, dtype, shape in zip(*columns, strict=True):
            name = ".".join(key)
            is_older = key[-1] in self._may_lack and td.get(key, None) is None
            tensor = (
                torch.zeros(shape, dtype=torch.bool, device="cpu") if is_older else _entry(td, key)
            )
            same_bits = (_SIGNED.get(dtype), _torch_dtype(dtype))
            if tensor.dtype not in same_bits or tensor.shape != shape:
                given = str(tensor.dtype).removeprefix("torch.")
                raise ValueError(
                    f"state entry {name!r} is {given} {tuple(tensor.shape)}, {self._kind} with "
                    f"{self._num_envs} envs expects {dtype} {tuple(shape)}"
                )
            value = tensor.detach().to("cpu", copy=True).numpy().view(dtype)
            arrays.append(_typed(jax.device_put(value, self._jax_device), leaf))
        return jax.tree_util.tree_unflatten(self._tree, arrays)

    def spec(self) -> Composite:
        """Spec of what ``export`` gives."""
        num_envs = self._num_envs
        device = self._device
        spec = Composite(shape=(num_envs,), device=device)
        for key, dtype, shape in zip(self._keys, self._dtypes, self._shapes, strict=True):
            torch_dtype = _SIGNED.get(dtype) or _torch_dtype(dtype)
            inner = spec
            for name in key[:-1]:
                if name not in inner:
                    inner[name] = Composite(shape=(num_envs,), device=device)
                inner = inner[name]
            inner[key[-1]] = Unbounded(shape=shape, dtype=torch_dtype, device=device)
        return spec

    def check_batch(self, td: Any) -> None:
        """Refuse, with TypeError or ValueError, what is no such TensorDict."""
        if not isinstance(td, TensorDictBase):
            raise TypeError(f"the state is {kind_of(td)}: pass what get_state() gave")
        if td.batch_size != (self._num_envs,):
            raise ValueError(
                f"the state is of batch size {list(td.batch_size)}, this env has {self._num_envs} "
                "envs"
            )


class Snapshots:
    """Turns batches of one game, or of a mixture of games, into TensorDicts and back; ``batch`` is
    any one of them.
    """

    def __init__(
        self, batched: BatchedGame[Any], batch: Batch, device: torch.device, jax_device: jax.Device
    ) -> None:
        num_envs = int(batch.step_count.shape[0])
        padded = jax.eval_shape(batched.pad, batch)
        self._leaves = TreeSnapshots(
            padded, num_envs, device, jax_device, batched.game.id, may_lack=_ENDS
        )
        self._batched = batched
        self._game_id = batched.game.id
        numbers = [fingerprint(group.game.id) for group in batched.groups]
        self._games = torch.tensor(numbers, device="cpu")[torch.from_numpy(batched.task(num_envs))]
        self._device = device

    def export(self, batch: Batch) -> TensorDict:
        """Copy a batch out of JAX.

        Returns:
            TensorDict [N] with ``key`` int32 [N, 2], ``state`` (nested, the game's own; in a
            mixture under the id of each game, and zero in the envs that play another), ``partial``
            bool [N], ``last_action`` and ``step_count`` int32 [N], ``episode_reward`` float32 [N],
            ``terminated`` and ``truncated`` bool [N], ``game`` int64 [N].
        """
        out = self._leaves.export(self._batched.pad(batch))
        out["game"] = self._games.to(self._device, copy=True)
        return out

    def load(self, td: TensorDictBase) -> Batch:
        """Copy into JAX what ``export`` gave, here or for another env of the same game and number
        of envs.

        Raises:
            ValueError: Another game, another number of envs, or leaves that are missing, or of
                another shape or type.
            TypeError: Not a TensorDict, or a leaf that is no tensor.
        """
        self._leaves.check_batch(td)
        self._check_game(td)
        return self._batched.unpad(self._leaves.load(td))

    def _check_game(self, td: TensorDictBase) -> None:
        """Refuse the state of another game."""
        game = _entry(td, ("game",))
        if game.dtype is not torch.int64 or game.shape != self._games.shape:
            raise ValueError(
                f"state entry 'game' is {game.dtype} {tuple(game.shape)}, expected torch.int64 "
                f"{tuple(self._games.shape)}"
            )
        differs = (game.cpu() != self._games).nonzero()
        if len(differs):
            env = int(differs[0])
            ids = {fingerprint(id): id for id in registered_ids()}
            theirs = ids.get(int(game[env]), "another game")
            raise ValueError(
                f"the state of env {env} is one of {theirs}, this env plays {self._game_id}"
            )

    def spec(self) -> Composite:
        """Spec of what ``export`` gives."""
        spec = self._leaves.spec()
        games = self._games
        spec["game"] = Unbounded(shape=games.shape, dtype=torch.int64, device=self._device)
        return spec
