"""Keeps XLA from computing wrong sums on a CPU, in the version of JAX that does. Loads no JAX."""

import os
import sys
import warnings
from importlib.metadata import PackageNotFoundError, version

FLAG = "--xla_cpu_experimental_ynn_fusion_type"
# versions of jaxlib; in others the flag may be unknown, and XLA would abort the process
AFFECTED = ("0.10.2",)


def guard_sums() -> None:
    """Turn off what gives wrong results for some batched reductions (issue 39103 of JAX), where it
    is known to.

    The flag is put into ``XLA_FLAGS``, unless it stands there with any value. Where that is too
    late, because JAX has started, or where the variable names a file, a warning says what to set.
    The games need none of this: they have the same bits with and without. It is for what is learned
    beside them in JAX.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if FLAG in flags or _jaxlib() not in AFFECTED:
        return
    bridge = sys.modules.get("jax._src.xla_bridge")
    has_started = getattr(bridge, "backends_are_initialized", bool)()  # bool() is false
    if has_started or (flags and not flags.startswith("-")):
        warnings.warn(
            f"jaxlib {_jaxlib()} computes some sums wrongly on a CPU (issue 39103 of JAX): import "
            f"arcade_torch before JAX computes anything, or set XLA_FLAGS={FLAG}= in the shell",
            stacklevel=2,
        )
        return
    os.environ["XLA_FLAGS"] = f"{flags} {FLAG}=".strip()


def _jaxlib() -> str:
    """The version of jaxlib that is installed, empty if none is."""
    try:
        return version("jaxlib")
    except PackageNotFoundError:
        return ""
