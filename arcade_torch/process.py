"""Refuses processes in which JAX would hang or cannot start, and warns from workers too. Loads no
JAX, and is loaded with the package.
"""

import logging
import multiprocessing
import os
import sys
import warnings

_started_in: int | None = None  # the first process known to have started JAX


def _before_fork() -> None:
    """Note that JAX has started: here, or in a process that this one was forked from."""
    global _started_in
    bridge = sys.modules.get("jax._src.xla_bridge")
    has_started = getattr(bridge, "backends_are_initialized", None)
    if _started_in is None and has_started is not None and has_started():
        _started_in = os.getpid()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=_before_fork)


def check_process() -> None:
    """Raise RuntimeError in a process that was forked after JAX had started: computing there would
    hang for ever.
    """
    if _started_in not in (None, os.getpid()):
        raise RuntimeError(
            "this process was forked after JAX had started, where JAX hangs: start workers with "
            "'spawn' (TorchRL: mp_start_method='spawn'; Gymnasium: "
            "vector_kwargs={'context': 'spawn'}, or leave vectorization_mode out of make_vec, "
            "which needs no workers)"
        )


def in_worker() -> bool:
    """Whether another process started this one."""
    return multiprocessing.parent_process() is not None


def warn(says: str) -> None:
    """Warn; in a worker by a line of the log, for there TorchRL silences warnings."""
    if in_worker():
        logging.getLogger("arcade_torch").warning(says)
    else:
        warnings.warn(says, stacklevel=3)


def missing_platform() -> str:
    """Why JAX cannot start on the platform that the environment asks for; empty if it can, or
    nothing was asked for.
    """
    names = [name for name in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME") if os.environ.get(name)]
    if not names or "jax" not in sys.modules:
        return ""
    try:
        sys.modules["jax"].devices()
    except Exception as error:  # an AssertionError without a word, or a RuntimeError
        asked = f"{names[0]} is {os.environ[names[0]]!r}"
        why = " ".join(str(error).split())[:200]
        return f"{asked}, but JAX has no such device here: unset it, or set it to cpu" + (
            f" ({why})" if why else ""
        )
    return ""
