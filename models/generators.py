"""Torch's random generators, put back as they were found."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["ONE_AT_A_TIME", "kept_generators"]

ONE_AT_A_TIME = threading.RLock()
"""Held while torch's global generators have the numbers of one piece of work: all threads of a
process draw from the same.
"""


@contextmanager
def kept_generators(seed: int | None = None) -> Iterator[None]:
    """Torch's global generators, that of the CPU and those of the cards in use, come back as they
    were; what does the same in other threads waits meanwhile.

    Args:
        seed: what they begin with meanwhile; None leaves them. ``torch.manual_seed`` would also
            seed cards that are first used later, for good.

    Example:
        >>> before = torch.get_rng_state()
        >>> with kept_generators(seed=1):
        ...     _ = torch.rand(3)
        >>> bool((torch.get_rng_state() == before).all())
        True
    """
    cards = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    with ONE_AT_A_TIME, torch.random.fork_rng(cards):
        if seed is not None:
            torch.default_generator.manual_seed(seed)
            if cards:
                torch.cuda.manual_seed_all(seed)
        yield
