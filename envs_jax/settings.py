"""The settings of JAX that games compute under, whatever the shell, the process or the caller has
set.

Some settings of JAX change which numbers a function gives: x64, the kind of random key, how
threefry counts, and more. JAX reads them while it traces. :func:`fixed` therefore enters one
context around a function, in which every such setting has the value that the games are made for,
and leaves it when the function returns. Under a ``jit`` that happens while the function is traced,
and compiled steps pay nothing.

``Game`` puts it around ``reset``, ``step`` and ``render`` of every class that is derived from it,
so that it holds under any ``jit``, ``vmap`` or ``scan`` of the caller, and for a game of one's own.
The functions of a batch, and those that make random keys, have it too. :func:`compiled` also
compiles where ``JAX_DISABLE_JIT`` says otherwise, since the last bits of floats depend on that.
"""

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from arcade_torch.envs_jax.validation import format_value

Function = TypeVar("Function", bound=Callable[..., Any])
KEY_KIND = "threefry2x32"
_WANTED = "expected uint32 [2], such as jax.random.PRNGKey(0, impl='threefry2x32')"


def _enter(stack: ExitStack) -> None:
    """Give every setting that changes numbers the value that the games are made for."""
    stack.enter_context(jax.enable_x64(False))
    stack.enter_context(jax.threefry_partitionable(True))
    stack.enter_context(jax.default_prng_impl(KEY_KIND))
    stack.enter_context(jax.enable_custom_prng(False))
    stack.enter_context(jax.legacy_prng_key("allow"))
    stack.enter_context(jax.numpy_dtype_promotion("standard"))
    stack.enter_context(jax.numpy_rank_promotion("allow"))
    stack.enter_context(jax.default_matmul_precision(None))


def fixed(function: Function) -> Function:
    """Let a function compute under the settings of the games.

    Args:
        function: A function of arrays. What it gives has the types of a process without x64.

    Returns:
        The function with the same signature.

    Example:
        >>> with jax.enable_x64(True):
        ...     str(jnp.arange(3).dtype), str(fixed(jnp.arange)(3).dtype)
        ('int64', 'int32')
    """

    @functools.wraps(function)
    def inner(*args: Any, **kwargs: Any) -> Any:
        with ExitStack() as stack:
            _enter(stack)
            return function(*args, **kwargs)

    return inner  # type: ignore[return-value]


def compiled(function: Callable[..., Any], **options: Any) -> Any:
    """``jax.jit`` of a function under the settings of the games; it compiles whatever
    ``JAX_DISABLE_JIT`` says.

    Args:
        function: What to compile.
        **options: Those of ``jax.jit``.

    Returns:
        What ``jax.jit`` gives.
    """

    @functools.wraps(function)
    def body(*args: Any, **kwargs: Any) -> Any:
        is_off = jax.config.jax_disable_jit  # type: ignore[attr-defined]
        if is_off:  # then JAX calls this itself instead of compiling it
            with jax.disable_jit(False):
                return jitted(*args, **kwargs)
        return function(*args, **kwargs)

    jitted = jax.jit(fixed(body), **options)
    return jitted


def may_be_nan(function: Function) -> Function:
    """Let a function give NaN where JAX_DEBUG_NANS looks for it: there it says something."""

    @functools.wraps(function)
    def inner(*args: Any, **kwargs: Any) -> Any:
        with jax.debug_nans(False):
            return function(*args, **kwargs)

    return inner  # type: ignore[return-value]


def is_key(leaf: Any) -> bool:
    """Whether an array is one of keys of ``jax.random.key``."""
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def as_numpy(tree: Any) -> Any:
    """A tree of arrays in numpy; keys of ``jax.random.key`` as their bits, uint32 [..., 2]."""

    def convert(leaf: Any) -> Any:
        return np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf)

    return jax.tree.map(convert, tree)


def raw_key(key: Any, ndim: int = 1) -> jax.Array:
    """The random bits of a key, or of many.

    Args:
        key: uint32 [..., 2], or keys of ``jax.random.key``, which are of one dimension less.
        ndim: Dimensions of the result.

    Returns:
        uint32 [..., 2].

    Raises:
        TypeError: No random key.
        ValueError: A key of another kind than threefry's, or of another number of dimensions.

    Example:
        >>> raw_key(jax.random.key(7)).tolist()
        [0, 7]
    """
    if not hasattr(key, "dtype"):
        raise TypeError(f"the random key is {format_value(key)}, {_WANTED}")
    if is_key(key):
        kind = str(jax.random.key_impl(key))
        if kind != KEY_KIND:
            raise ValueError(f"the random key is of the kind {kind!r}, {_WANTED}")
        key = jax.random.key_data(key)
    if key.dtype != jnp.uint32 or key.ndim != ndim or key.shape[-1] != 2:
        raise ValueError(f"the random key is {key.dtype} {list(key.shape)}, {_WANTED}")
    return jnp.asarray(key)
