"""Gradients of features with respect to frames, for many cotangents and long after the features are known.

Autograd keeps everything between frames and features until the last cotangent has been pulled back, or computes it
twice. A ``record`` method gives the features and a function that pulls cotangents back to the frames: for any encoder
by a second forward pass (:func:`recorded_twice`), for the paper's from a small tape (``tape.py``).
"""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from arcade_torch.models.tiles import as_pictures, as_tiles

__all__ = ["Pull", "Record", "gathered", "record_of", "recorded_twice"]

Pull = Callable[[Tensor, Tensor], Iterator[Tensor]]
"""``(cotangents [K, n, E], index int64 [n] of the frames they belong to) -> gradients``, some frames after the other.

Each is [K, m, C, p, p, h, w], for the next m frames: tiles of p x p pixels, see :func:`as_pictures`. It is good until
the next is asked for. :func:`gathered` puts all together.
"""

Record = Callable[[Tensor, torch.dtype], tuple[Tensor, Pull]]
"""``(frames uint8 or float [N, S, S, C], dtype that they are given to the encoder in) -> (features [N, E], Pull)``"""


def record_of(module: Any, *methods: str) -> Record | None:
    """The method ``record`` of a module, unless a subclass has changed what it records.

    Args:
        module: an encoder, a network, or anything else.
        methods: names of the methods that ``record`` stands for.

    Returns:
        The bound method, or None if there is none or one of ``methods`` was overridden below it.
    """

    def depth(name: str) -> int:
        return next((i for i, kind in enumerate(type(module).__mro__) if name in vars(kind)), -1)

    where = depth("record")
    changed = any(0 <= depth(name) < where or name in vars(module) for name in methods)
    return None if where < 0 or changed else module.record


def recorded_twice(
    encode: Callable[[Tensor], Tensor], frames: Tensor, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Pull]:
    """Record any encoder; it is run again for the gradients.

    Args:
        encode: frames [n, S, S, C] to features [n, E], each frame on its own.
        frames: uint8 or float [N, S, S, C]; kept as they are.
        dtype: of the frames that ``encode`` is given.

    Returns:
        ``(features [N, E] without a graph, Pull)``.
    """
    with torch.no_grad():
        features = encode(frames.to(dtype))

    def pull(cotangents: Tensor, index: Tensor) -> Iterator[Tensor]:
        with torch.enable_grad():
            part = frames[index].to(dtype).requires_grad_()
            again = encode(part)
            gradients = torch.zeros(len(cotangents), *part.shape, dtype=part.dtype, device=part.device)
            for row, gradient in zip(cotangents.to(again.dtype), gradients, strict=True):
                (found,) = torch.autograd.grad(again, part, row, retain_graph=True, allow_unused=True)
                if found is not None:
                    gradient.copy_(found)
        yield as_tiles(gradients)

    return features, pull


def gathered(gradients: Iterator[Tensor], height: int, width: int) -> Tensor:
    """What a `Pull` gives, as one tensor [K, n, height, width, C]."""
    return torch.cat([as_pictures(part, height, width).clone() for part in gradients], dim=1).movedim(2, -1)
