"""Rotary position embedding: turns pairs of channels by angles that grow with the position
(RoPE).
"""

import math

import torch
from torch import Tensor

__all__ = ["angles", "rotate", "rotate_pairs"]

LOG_BASE = math.log(10_000.0)


def angles(position: Tensor, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Cosine and sine of the angle of every channel pair at every position.

    Args:
        position: int64 [...], in steps.
        width: number of channels; the last one of an odd number is left alone.
        dtype: of the result; angles are float64 until the cosine is taken, so that two far
            positions differ by as much as two near ones.

    Returns:
        (cosine, sine), each [..., width // 2].

    Source: Su et al. (2021), arXiv 2104.09864, eq. 15.
    """
    pairs = width // 2
    frequency = torch.exp(
        torch.arange(pairs, dtype=torch.float64, device=position.device)
        * (-LOG_BASE / max(pairs, 1))
    )
    angle = position.to(torch.float64).unsqueeze(-1) * frequency
    return angle.cos().to(dtype), angle.sin().to(dtype)


def rotate(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Turn channel pairs (2i, 2i + 1).

    Args:
        x: [..., W].
        cosine: [..., W // 2], see :func:`angles`.
        sine: like ``cosine``.

    Returns:
        [..., W]: first the first channels of all pairs, then the second ones, then what is left
        over. The order does not matter to a product of two rotated vectors; a matrix that rotated
        vectors are multiplied by, as in TTT, has its axis in this order.
    """
    turned = 2 * cosine.shape[-1]
    first = x[..., 0:turned:2]
    second = x[..., 1:turned:2]
    parts = [first * cosine - second * sine, first * sine + second * cosine]
    return torch.cat(parts if turned == x.shape[-1] else [*parts, x[..., turned:]], dim=-1)


def rotate_pairs(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """:func:`rotate`, with every channel left in its place.

    Pairs are complex numbers and turning is one product of them: one pass over memory, on a CPU
    several times as fast as picking out every second channel. Graphs that are compiled, and what
    cannot be read as pairs, go by the latter.

    Args:
        x: [..., W].
        cosine: [..., W // 2], see :func:`angles`.
        sine: like ``cosine``.

    Returns:
        [..., W].
    """
    if _is_pairs(x):
        turned = torch.view_as_complex(x.unflatten(-1, (-1, 2))) * torch.complex(cosine, sine)
        return torch.view_as_real(turned).flatten(-2)
    turned, rest = rotate(x, cosine, sine).tensor_split([2 * cosine.shape[-1]], dim=-1)
    return torch.cat([turned.unflatten(-1, (2, -1)).mT.flatten(-2), rest], dim=-1)


def _is_pairs(x: Tensor) -> bool:
    """Whether the memory of x can be read as complex numbers, outside of a graph (inductor does not
    fuse those).
    """
    if torch.compiler.is_compiling() or x.dtype not in (torch.float32, torch.float64):
        return False
    return x.stride(-1) == 1 and not any(
        n % 2 for n in (x.shape[-1], x.storage_offset(), *x.stride()[:-1])
    )
