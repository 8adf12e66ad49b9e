"""All laws of a memory model one by one, also behind a broken one."""

from typing import NamedTuple

import torch
from torch import nn

from arcade_torch.models.checks import MemoryLawError, _laws, _subject

__all__ = ["LawResult", "law_results"]


class LawResult(NamedTuple):
    """How a module stands by one law."""

    law: str
    """Its name, as in the keys that ``check_memory`` returns."""
    passed: bool
    discrepancy: float
    """Largest discrepancy that was measured; NaN if the law is broken otherwise than by numbers."""
    message: str
    """What is wrong and its likely cause; empty if the law is kept."""


def law_results(
    module: nn.Module, *, input_size: int | None = None, seed: int = 0
) -> list[LawResult]:
    """Check every law in float64; ``check_memory`` stops at the first that is broken.

    Args:
        module: a memory model; a copy of it is checked.
        input_size: D; None reads ``module.input_size``.
        seed: of the random inputs.

    Returns:
        The laws in the order of ``check_memory``. A module that fails while a law is checked
        breaks it.

    Raises:
        ValueError, TypeError: the input size is not known; there is no ``initial_state``.

    Example:
        >>> from arcade_torch.models import make_memory
        >>> law_results(make_memory("mingru", 3, 4))[0].passed
        True
    """
    subject = _subject(module, input_size, torch.float64, None)
    results = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for name, law in _laws(module, torch.float64, True).items():
            try:
                results.append(LawResult(name, True, law(subject, name), ""))
            except MemoryLawError as error:
                results.append(LawResult(name, False, error.discrepancy, str(error)))
            except Exception as error:
                message = f"{type(error).__name__}: {' '.join(str(error).split())}"
                results.append(LawResult(name, False, float("nan"), message))
    return results
