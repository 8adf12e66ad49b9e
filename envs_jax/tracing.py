"""What functions of a game or an env give, by shapes and types, and whether they are pure; nothing
is compiled.
"""

import os
import re
import traceback
from collections.abc import Callable
from typing import Any

import jax

from arcade_torch.envs_jax.settings import as_numpy
from arcade_torch.envs_jax.validation import kind_of, with_article

_ADDRESS = re.compile("0x[0-9a-f]+")  # of a Python object; another one at every tracing
_OURS = __name__.partition(".")[0]
_LIBRARIES = {_OURS, "contextlib", "functools", "jax", "jaxlib", "numpy"}
# The first that fits says what to write; of two related errors the narrower one stands first.
_HINTS: list[tuple[type[Exception], str]] = [
    (jax.errors.TracerBoolConversionError, "use jnp.where instead of if"),
    (
        jax.errors.TracerIntegerConversionError,
        "use jnp.array(...) instead of a list, and jax.lax.fori_loop instead of range",
    ),
    (jax.errors.TracerArrayConversionError, "use jnp instead of np"),
    (jax.errors.ConcretizationTypeError, "use .astype instead of int and float"),
]


class ContractError(TypeError):
    """Says by itself, in one line, what is wrong with what a function gives."""


def traced(name: str, method: str, function: Callable[..., Any], *args: Any) -> Any:
    """What a function would give, by shapes and types; it is traced twice.

    Args:
        name: Of the game or the env, for messages.
        method: Of the function, for messages.
        function: Of arrays, to arrays.
        *args: Trees of ``jax.ShapeDtypeStruct``.

    Returns:
        The tree that the function gives, of ``jax.ShapeDtypeStruct``.

    Raises:
        ValueError: It cannot be traced, or the second tracing gives another program: it depends on
            what Python keeps between calls, which JAX reads once for all steps.
        TypeError: The function raised a ``ContractError``; in its words.
    """
    try:
        # a function of its own each time, or JAX hands out the program that it has
        program, given = jax.make_jaxpr(lambda *a: function(*a), return_shape=True)(*args)
        again = jax.make_jaxpr(lambda *a: function(*a))(*args)
    except ContractError as error:
        raise TypeError(str(error)) from None
    except Exception as error:
        raise ValueError(f"{name}: {method} cannot be traced by JAX, {_refusal(error)}") from error
    if any(isinstance(const, jax.core.Tracer) for const in (*program.consts, *again.consts)):
        raise ValueError(
            f"{name}: {method} uses an array that an earlier call kept outside of the state, in "
            "self or a global: keep in the state what changes"
        )
    if not _is_same(program, again):
        raise ValueError(
            f"{name}: {method} is another function when it is called again, and JAX calls it once "
            "for all steps: keep in the state what changes, and draw random numbers from the key"
        )
    return given


def _refusal(error: Exception) -> str:
    """What is wanted of a function that raised this while it was traced, and where it did."""
    hint = next((f"; {hint}" for kind, hint in _HINTS if isinstance(error, kind)), "")
    reason = str(error).strip().partition("\n")[0].rstrip(".")
    place = _place(error)
    return f"wanted a pure function of arrays{hint} ({type(error).__name__}: {reason}{place})"


def _place(error: Exception) -> str:
    """The last line outside of the libraries that the error went through, or nothing."""
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__", ""))
        if module.partition(".")[0] not in _LIBRARIES:
            place = f"; {os.path.basename(frame.f_code.co_filename)}, line {line}"
    return place


def _is_same(one: Any, other: Any) -> bool:
    """Whether two programs are the same, their constants too."""
    texts = [_ADDRESS.sub("", str(program)) for program in (one, other)]
    pairs = zip(one.consts, other.consts, strict=False)
    return texts[0] == texts[1] and all(_is_equal(*pair) for pair in pairs)


def _is_equal(one: Any, other: Any) -> bool:
    """Whether two constants have the same bits."""
    return bool(as_numpy(one).tobytes() == as_numpy(other).tobytes())


def kind_of_traced(value: Any) -> str:
    """What ``kind_of`` says of a value; an array that is known by its shape alone is one."""
    return "an array" if hasattr(value, "dtype") else kind_of(value)


def check_array(name: str, subject: str, value: Any, shape: tuple[int, ...], dtype: str) -> None:
    """Raise ValueError for anything but an array of this shape and type."""
    if not hasattr(value, "shape"):
        raise ValueError(f"{name}: {subject} {kind_of(value)}, wanted {dtype} {list(shape)}")
    if tuple(value.shape) != shape or str(value.dtype) != dtype:
        raise ValueError(
            f"{name}: {subject} {value.dtype} {list(value.shape)}, wanted {dtype} {list(shape)}"
        )


def check_same(name: str, subject: str, first: Any, following: Any) -> None:
    """Raise ValueError unless ``step`` gives a tree with the leaves of that of ``reset``; both are
    not empty.
    """
    ours = leaves(first, subject)
    theirs = leaves(following, subject)
    if not ours:
        raise ValueError(f"{name}: reset gives {with_article(subject)} without any array")
    before: object = jax.tree.structure(first)
    if before != jax.tree.structure(following):
        raise ValueError(
            f"{name}: step gives {with_article(subject)} of another structure, with "
            f"{', '.join(theirs) or 'nothing'}; wanted that of reset, {kind_of_traced(first)} with "
            f"{', '.join(ours)}"
        )
    for leaf, wanted in ours.items():
        place = subject if leaf == subject else f"{subject} entry {leaf}"
        given = theirs[leaf]
        check_array(name, f"step gives {place} as", given, tuple(wanted.shape), str(wanted.dtype))


def leaves(tree: Any, subject: str) -> dict[str, Any]:
    """The arrays of a tree by name; a tree that is an array has the name ``subject``."""
    named = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path).lstrip(".") or subject: leaf for path, leaf in named}
