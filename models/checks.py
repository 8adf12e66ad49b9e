"""Checks that a module, ours or anybody's, is a correct memory model: up to the first law that it
breaks, or all laws one by one.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import nn

from arcade_torch.models.arguments import check_flags, check_seed
from arcade_torch.models.generators import kept_generators
from arcade_torch.models.law_subject import MemoryLawError, subject_of
from arcade_torch.models.laws import laws_of

__all__ = ["LawResult", "MemoryLawError", "check_memory", "law_results"]


def check_memory(
    module: nn.Module,
    *,
    input_size: int | None = None,
    dtype: torch.dtype = torch.float64,
    tolerance: float | None = None,
    seed: int = 0,
    gradients: bool = True,
) -> dict[str, float]:
    """Check that a module is a correct memory model.

    Works on a copy in evaluation mode, which training mode has to equal, with random inputs; takes
    a second or so for small sizes.

    Args:
        module: a memory model, see :class:`MemoryContract`; ``replay`` is checked too where there
            is one. One with ``averages_values = True`` has one law more: the same input at every
            step gives the same output at every step, as in attention. One that has a part with
            ``surrogate_gradients = True``, a step function with the derivative of another, is asked
            for the gradients of a call a step in every type: finite differences know no such step.
        input_size: D; None reads ``module.input_size``.
        dtype: of parameters and inputs during the check. float64 finds the most; take float32,
            bfloat16 or float16 for kernels that know nothing else. A module without a weight
            or a buffer of floats is checked in float32.
        tolerance: largest difference allowed between two ways to compute the same, as a share of
            the largest entry where that is above 1; None for 1e-7 in float64, 1e-4 in float32, 0.01
            in float16 and 0.1 in bfloat16.
        seed: of the random inputs.
        gradients: also compare gradients (the slowest law): in float64 with finite differences, in
            other types those of one call with those of a call a step.

    Returns:
        For each law the largest discrepancy that was found (all within tolerance).

    Raises:
        MemoryLawError: a law is broken; says which, by how much, and what usually causes it.
        ValueError: the input size is not known, ``dtype`` is none of the four, or another argument
            is none of its kind.
        TypeError: no ``nn.Module``, one without ``initial_state``, or one with a quantised part.

    Example:
        >>> from arcade_torch.models import check_memory, make_memory
        >>> sorted(check_memory(make_memory("mingru", 3, 4)))[:2]
        ['batch rows are independent', 'equal calls give equal results']
    """
    subject = subject_of(module, input_size, dtype, tolerance)
    check_flags(gradients=gradients)
    check_seed(seed)
    discrepancies = {}
    with kept_generators(seed):
        for name, law in laws_of(module, subject.dtype, gradients).items():
            discrepancies[name] = law(replace(subject, law=name))
    return discrepancies


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
        ValueError: the input size is not known, or another argument is none of its kind.
        TypeError: no ``nn.Module``, one without ``initial_state``, or one with a quantised part.

    Example:
        >>> from arcade_torch.models import make_memory
        >>> law_results(make_memory("mingru", 3, 4))[0].passed
        True
    """
    subject = subject_of(module, input_size, torch.float64, None)
    check_seed(seed)
    results = []
    with kept_generators(seed):
        for name, law in laws_of(module, subject.dtype, True).items():
            try:
                results.append(LawResult(name, True, law(replace(subject, law=name)), ""))
            except MemoryLawError as error:
                results.append(LawResult(name, False, error.discrepancy, str(error)))
            except Exception as error:
                message = f"{type(error).__name__}: {' '.join(str(error).split())}"
                results.append(LawResult(name, False, float("nan"), message))
    return results
