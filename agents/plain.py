"""Nested state as plain tensors, dicts and numbers, so that it can be loaded without unpickling anything else."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

_MARK = "__tensordict__"


def to_plain(value: Any) -> Any:
    """Replace TensorDicts and numpy arrays by dicts and tensors, recursively.

    Args:
        value: nested state of tensors, TensorDicts, numpy arrays, dicts, lists, tuples, numbers, text, None.

    Returns:
        The same nesting; :func:`from_plain` turns the marked dicts back into TensorDicts.

    Raises:
        TypeError: something else is in it.
    """
    if isinstance(value, TensorDictBase):
        items = {key: to_plain(value.get(key)) for key in value.keys()}  # noqa: SIM118 (a TensorDict iterates over its batch)
        return {_MARK: list(value.batch_size), "items": items}
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, np.ndarray):
        try:
            return torch.from_numpy(np.ascontiguousarray(value).copy())
        except TypeError as error:
            raise TypeError(f"cannot save an array of {value.dtype}; torch has numbers and bools only") from error
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(to_plain(item) for item in value)
    if value is None or isinstance(value, (bool, int, float, str, bytes)):
        return value
    raise TypeError(f"cannot save a {type(value).__name__}; allowed are tensors, TensorDicts, arrays, numbers and text")


def from_plain(value: Any) -> Any:
    """The inverse of :func:`to_plain`, except that numpy arrays stay tensors.

    Example:
        >>> state = TensorDict({"h": torch.zeros(2, 3)}, [2])
        >>> from_plain(to_plain({"state": state}))["state"].batch_size
        torch.Size([2])
    """
    if isinstance(value, dict):
        if _MARK in value:
            return TensorDict({k: from_plain(v) for k, v in value["items"].items()}, batch_size=value[_MARK])
        return {key: from_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(from_plain(item) for item in value)
    return value
