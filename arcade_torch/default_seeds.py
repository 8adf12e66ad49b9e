"""Notices envs that play the very same episodes because nobody gave them a seed."""

import weakref
from collections.abc import Hashable
from typing import Any

from arcade_torch.process import in_worker, warn


class DefaultSeed(int):
    """A seed that nobody chose: equal to 0, and told from a 0 that was given."""


DEFAULT_SEED = DefaultSeed(0)
_LIVE: dict[Hashable, "weakref.WeakSet[Any]"] = {}  # envs with the default seed, by what they play
_warned = False


def note(env: Any, seed: int | None, plays: Hashable) -> None:
    """Remember what an env plays, if its seed is the default."""
    if isinstance(seed, DefaultSeed):
        _LIVE.setdefault(plays, weakref.WeakSet()).add(env)


def forget(env: Any) -> None:
    """Watch an env no longer: it has been given a seed."""
    for plays, envs in list(_LIVE.items()):
        envs.discard(env)
        if not envs:
            del _LIVE[plays]


def warn_of_twins(env: Any) -> None:
    """Say once in a process that an env which begins plays what others play, in this process or in
    other workers.
    """
    global _warned
    noted = [envs for envs in _LIVE.values() if env in envs]
    if not noted or _warned:
        return
    if in_worker():
        others = "every worker process that makes its env so"
    elif any(len(envs) > 1 for envs in noted):
        others = "another env of this process that was made so"
    else:
        return
    _warned = True
    says = (
        f"this env has the default seed, 0, and plays the very same episodes as {others}: give "
        "each its own (arcade_torch.make(..., seed=i)), or call set_seed on the env that holds them"
    )
    warn(says)
