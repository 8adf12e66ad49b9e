"""Whether the saved state of a trainer can be one of this trainer: the same names, types and sizes.

Torch and Python take many a wrong value without a word, and fail in the middle of the training that
follows.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from arcade_torch.envs_jax.validation import kind_of

LARGEST = 2**63
_MOMENTS = {"step", "exp_avg", "exp_avg_sq"}


def check_state(saved: Any, expected: Any, name: str = "the state") -> None:
    """Refuse a saved state that differs from the expected one in more than values.

    Args:
        saved: what a file holds: tensors, numbers, text, None, and tables and lists of them.
        expected: the like of this trainer. Names that only one side has are left to those who read
            them, and so is what an empty table or list may hold.
        name: of the state in the message.

    Raises:
        ValueError: a part has another type or another size; names the part.
    """
    if isinstance(expected, Mapping):
        _require(isinstance(saved, Mapping), name, saved, "a table")
        for key in expected.keys() & saved.keys():
            check_state(saved[key], expected[key], f"{name}[{key!r}]")
    elif isinstance(expected, list | tuple):
        _require(isinstance(saved, list | tuple), name, saved, "a list")
        fits = not expected or len(saved) == len(expected)
        _require(fits, name, saved, f"a list of {len(expected)}")
        for index, (one, other) in enumerate(zip(saved, expected, strict=False)):
            check_state(one, other, f"{name}[{index}]")
    elif isinstance(expected, Tensor):
        _require(isinstance(saved, Tensor), name, saved, _described(expected))
        same = (saved.dtype, saved.shape) == (expected.dtype, expected.shape)
        _require(same, name, saved, _described(expected))
    else:
        _check_value(saved, expected, name)


def _check_value(saved: Any, expected: Any, name: str) -> None:
    """Refuse a value of another type; None stands where there is no number yet."""
    if isinstance(expected, bool):
        _require(isinstance(saved, bool), name, saved, "true or false")
    elif isinstance(expected, int):
        _require(type(saved) is int and abs(saved) < LARGEST, name, saved, "a whole number")
    elif isinstance(expected, float):
        _require(_is_finite(saved), name, saved, "a finite number")
    elif expected is None:
        _require(saved is None or _is_finite(saved), name, saved, "a finite number or none")


def check_optimizer(saved: Any, parameters: Sequence[nn.Parameter]) -> None:
    """Refuse the saved state of Adam or RAdam if its averages are not those of these parameters, by
    a ``ValueError``.
    """
    name = "the state['optimizer']"
    is_state = isinstance(saved, Mapping) and isinstance(saved.get("state"), Mapping)
    _require(is_state, name, saved, "one of an optimiser")
    for index, averages in saved["state"].items():
        is_place = type(index) is int and 0 <= index < len(parameters)
        _require(is_place, name, index, "numbers of parameters")
        part = f"{name}[{index}]"
        complete = isinstance(averages, Mapping) and set(averages) == _MOMENTS
        _require(complete, part, averages, f"a table of {', '.join(sorted(_MOMENTS))}")
        step = averages["step"]
        count = isinstance(step, Tensor) and step.shape == () and 0 <= float(step) < LARGEST
        _require(count, f"{part}['step']", step, "a count of steps")
        parameter = parameters[index]
        for moment in ("exp_avg", "exp_avg_sq"):
            check_state(averages[moment], parameter, f"{part}[{moment!r}]")


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < LARGEST and math.isfinite(value)


def _described(value: Any) -> str:
    """A value in a few words; a file may hold one that is too long to print."""
    if isinstance(value, Tensor):
        return f"a tensor {str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
    if isinstance(value, Mapping | list | tuple):
        return f"{kind_of(value)} of {len(value)}"
    if isinstance(value, str):
        return repr(value[:40])
    if isinstance(value, int) and abs(value) >= LARGEST:
        return kind_of(value)
    return repr(value) if isinstance(value, int | float | None) else kind_of(value)


def _require(fits: bool, name: str, saved: Any, allowed: str) -> None:
    if not fits:
        raise ValueError(f"{name} is {_described(saved)}, expected {allowed}")
