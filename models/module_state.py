"""The recurrent state of a module of another library: tensors in tuples, lists and dictionaries."""

import copy
from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

__all__ = ["Path", "arrange", "empty_like", "shapes_of", "tensors_of"]

Path = tuple[Any, ...]
"""Keys and positions that lead to a tensor of a state."""


def tensors_of(state: Any, path: Path = ()) -> dict[Path, Any]:
    """What stands in a state, by path; None, for no state of a part, is left out.

    Args:
        state: a tensor, or tuples, lists, dictionaries and TensorDicts of them, inside of each
            other too.
        path: where it stands in a larger one.

    Returns:
        In order; what is no tensor as well.
    """
    if state is None:
        return {}
    if isinstance(state, Mapping):
        parts = list(state.items())
    elif isinstance(state, (tuple, list)):
        parts = list(enumerate(state))
    else:
        return {path: state}
    tensors = {}
    for key, part in parts:
        tensors.update(tensors_of(part, (*path, key)))
    return tensors


def arrange(tensors: Mapping[Path, Tensor], layout: Any, rows: int, path: Path = ()) -> Any:
    """The inverse of :func:`tensors_of`.

    Args:
        tensors: by path.
        layout: a state, of any batch, that has tensors of the same paths.
        rows: batch size of the tensors, which TensorDicts carry too.
        path: where ``layout`` stands in a larger one.
    """
    if layout is None:
        return None
    if not isinstance(layout, (Mapping, tuple, list)):
        return tensors[path]
    if not isinstance(layout, Mapping):
        parts = [arrange(tensors, part, rows, (*path, i)) for i, part in enumerate(layout)]
        has_names = hasattr(layout, "_fields")
        return type(layout)(*parts) if has_names else type(layout)(parts)
    by_key = {}
    for key, part in layout.items():
        by_key[key] = arrange(tensors, part, rows, (*path, key))
    if isinstance(layout, TensorDictBase):
        return TensorDict(by_key, batch_size=[rows] if layout.batch_dims else [])
    state: Any = copy.copy(layout)  # also of classes that are made otherwise than from a dictionary
    for key, part in by_key.items():
        state[key] = part
    return state


def empty_like(state: Any, rows: int) -> Any:
    """The same arrangement with tensors that have no data."""
    without_data = {}
    for path, tensor in tensors_of(state).items():
        without_data[path] = tensor.detach().to("meta")
    return arrange(without_data, state, rows)


def shapes_of(tensors: Mapping[Path, Tensor]) -> dict[Path, list[int]]:
    """Shapes, by path."""
    return {path: list(tensor.shape) for path, tensor in tensors.items()}
