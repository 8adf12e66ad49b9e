"""Sizes, switches and numbers that are checked: one line says what arrived and what is allowed."""

import math
import numbers
import operator
from typing import Any

import numpy as np
import torch

__all__ = [
    "check_flags",
    "check_keys",
    "check_numbers",
    "check_seed",
    "check_sizes",
    "is_number",
    "is_whole",
]


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number, of numpy or of torch too; True and False are none."""
    if type(value) is bool:
        return False
    if isinstance(value, int | torch.SymInt):
        return True
    try:
        operator.index(value)
    except TypeError:
        return False
    return True


def check_sizes(**sizes: Any) -> None:
    """Refuse, by name, what is no whole number (ValueError); how large it may be the caller
    knows.
    """
    for name, value in sizes.items():
        if not is_whole(value):
            raise ValueError(f"{name} must be a whole number, got {value!r}")


def check_flags(**flags: Any) -> None:
    """Refuse, by name, what is neither True nor False (ValueError): a word such as "no" would count
    as True.
    """
    for name, value in flags.items():
        if not isinstance(value, bool | np.bool_):
            raise ValueError(f"{name} must be True or False, got {value!r}")


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, of numpy too; True and False are none."""
    is_real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return is_real and math.isfinite(value)


def check_keys(**keys: Any) -> None:
    """Refuse, by name, what is no key of a TensorDict (ValueError)."""
    for name, key in keys.items():
        parts = key if isinstance(key, tuple) and key else (key,)
        if not all(isinstance(part, str) for part in parts):
            raise ValueError(f"{name} must be a string or a tuple of strings, got {key!r}")


def check_numbers(**values: Any) -> None:
    """Refuse, by name, what is no finite number (ValueError)."""
    for name, value in values.items():
        if not is_number(value):
            raise ValueError(f"{name} must be a number, got {value!r}")


def check_seed(seed: Any) -> None:
    """Refuse what is no seed of torch (ValueError)."""
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= abs(seed) < 2**63:
        raise ValueError(f"seed must be a whole number below 2**63, got {seed!r}")
