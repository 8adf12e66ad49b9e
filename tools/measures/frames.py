"""Frames of any kind: where their channels are, how bright white is, and pictures of them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arcade_torch.agents.checked import require
from arcade_torch.tools.measures.keys import Channels

BYTE = 255.0  # white in whole numbers
MOST_FLOAT = 16.0
"""Floats above it are no shares of white, whatever they are."""
COLOURS = ((90, 160, 255), (255, 200, 60), (90, 220, 120), (255, 100, 100), (200, 130, 255))
"""Of the channels of frames that have neither one nor three of them."""


def channel_axis(shape: Sequence[int], channels: Channels | None) -> int | None:
    """Which axis of a frame holds its channels: 0, -1, or None where it has no three axes.

    Without ``channels`` it is the shorter end of the shape, the last of two that are equal.

    Example:
        >>> channel_axis((84, 84, 3), None), channel_axis((1, 84, 84), None)
        (-1, 0)
    """
    if len(shape) != 3:
        return None
    if channels is None:
        return 0 if shape[0] < shape[-1] else -1
    return 0 if channels == "first" else -1


def float_type(frames: Tensor) -> torch.dtype:
    """The type in which frames are read as floats: their own, single precision for whole numbers
    and truth values.
    """
    return frames.dtype if frames.is_floating_point() else torch.float32


@contextmanager
def floats_are_taken(dtype: torch.dtype) -> Iterator[None]:
    """Say in one line of a policy that breaks off where frames of ``dtype`` are handed to it as
    floats.
    """
    try:
        yield
    except RuntimeError as error:
        if dtype.is_floating_point:
            raise
        raise ValueError(
            f"the policy must take floats where the env gives {dtype}, for noise and gradients: "
            "convert them inside of it, for an embedding by frames.long(); got "
            f"{str(error).splitlines()[0]}"
        ) from error


def as_array(frames: Tensor) -> NDArray[Any]:
    """Frames as an array; NumPy has no bfloat16."""
    values = frames.float() if frames.dtype == torch.bfloat16 else frames
    return np.asarray(values.cpu().numpy())


def white_of(frames: Tensor, white: float | None = None) -> float:
    """The value of a white pixel: 255 for whole numbers, 1 for floats and truth values.

    Raises:
        ValueError: floats that reach far beyond 1, and nobody says what white is.
    """
    if white is not None:
        require(white > 0, "white", white, "above 0")
        return white
    if frames.dtype != torch.bool and not frames.is_floating_point():
        return BYTE
    peak = float(frames.max())
    if peak > MOST_FLOAT:
        raise ValueError(
            f"float frames must be shares of white, got {peak:g}: say what white is (white=255.0)"
        )
    return 1.0


def pictures(
    frames: Any, channels: Channels | None = None, white: float | None = None
) -> NDArray[np.uint8]:
    """Pictures that can be drawn of frames [..., *frame], uint8 [..., H, W, 3].

    One channel is grey, three are red, green and blue, and of any other number every channel has a
    colour, the brightest in front. Vectors are a row of grey cells.
    """
    values = torch.as_tensor(frames, device="cpu")
    axis = channel_axis(values.shape[-3:], channels) if values.ndim > 3 else None
    if values.dtype == torch.uint8 and axis == -1 and values.shape[-1] == 3:
        return np.asarray(values.cpu().numpy())
    shares = (values.double() / white_of(values, white)).clamp(0, 1)
    if values.ndim == 2:
        shares = shares[:, None, :]  # a vector a frame
    if axis is None:
        shares = shares.unsqueeze(-1)
    elif axis == 0:
        shares = shares.movedim(-3, -1)
    count = shares.shape[-1]
    if count == 1:
        shares = shares.expand(*shares.shape[:-1], 3)
    elif count != 3:
        table = [COLOURS[place % len(COLOURS)] for place in range(count)]
        colours = torch.tensor(table, dtype=shares.dtype, device=shares.device) / BYTE
        shares = (shares.unsqueeze(-1) * colours).amax(-2)
    return np.asarray((BYTE * shares).round().byte().cpu().numpy())


def check_range(frames: Tensor, white: float) -> None:
    """Refuse frames that clipping to 0 to ``white`` would change, noise or none (ValueError)."""
    lowest = float(frames.min())
    highest = float(frames.max())
    if lowest < 0 or highest > white:
        raise ValueError(
            f"clip=True keeps pixels in 0 to {white:g}, got frames from {lowest:g} to "
            f"{highest:g}: leave clip out, or name white="
        )
