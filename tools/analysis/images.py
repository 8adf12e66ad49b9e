"""Heat over frames: smoothing, the afmhot colours, overlays, and PNG bytes, in numpy alone."""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]

SIGMA_PX = 6.0
"""Width of the smoothing at 128 px, as in the paper's figures; scales with the frame."""


def smooth(maps: NDArray[np.floating], sigma_px: float) -> Floats:
    """Gaussian smoothing of the last two axes, reflecting at the borders.

    Args:
        maps: float [..., H, W].
        sigma_px: standard deviation in pixels; below 0.01 nothing changes.

    Returns:
        float64 [..., H, W]; the sum of each map is kept.
    """
    result = np.asarray(maps, dtype=np.float64)
    if sigma_px < 0.01:
        return result
    radius = int(np.ceil(3 * sigma_px))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma_px) ** 2)
    kernel /= kernel.sum()
    for axis in (-2, -1):
        widths = [(0, 0)] * result.ndim
        widths[axis] = (radius, radius)
        padded = np.pad(result, widths, mode="symmetric")
        windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.size, axis=axis)
        result = windows @ kernel
    return result


def afmhot(values: NDArray[np.floating]) -> Floats:
    """The colour map black - red - yellow - white.

    Args:
        values: float [...], clipped to [0, 1].

    Returns:
        float64 [..., 3] in [0, 1].
    """
    x = 2 * np.clip(np.asarray(values, dtype=np.float64), 0, 1)
    return np.stack([np.clip(x, 0, 1), np.clip(x - 0.5, 0, 1), np.clip(x - 1, 0, 1)], axis=-1)


def scaled(maps: NDArray[np.floating], sigma_px: float) -> tuple[Floats, float]:
    """Smoothed maps on one scale for the whole row: the square root of the share of the brightest value.

    The root makes a frame visible that has a hundredth of the brightest; norms that are squares become lengths.

    Args:
        maps: float [T, H, W], not negative.
        sigma_px: smoothing.

    Returns:
        float64 [T, H, W] in [0, 1], and the smoothed value that is drawn brightest.
    """
    soft = smooth(maps, sigma_px)
    peak = float(soft.max(initial=0.0))
    return (np.sqrt(soft / peak) if peak > 0 else soft), peak


def overlay(frames: Image, heat: NDArray[np.floating], alpha: float = 0.5) -> Image:
    """Frames with heat over them.

    Args:
        frames: uint8 [T, H, W, 3].
        heat: float [T, H, W] in [0, 1].
        alpha: weight of the heat, in [0, 1].

    Returns:
        uint8 [T, H, W, 3].
    """
    mixed = (1 - alpha) * frames.astype(np.float64) + alpha * 255 * afmhot(heat)
    return np.rint(mixed).astype(np.uint8)


def png(image: Image) -> bytes:
    """An image as a PNG file.

    Args:
        image: uint8 [H, W, 3].

    Returns:
        The bytes of the file.

    Raises:
        ValueError: the array is not such an image.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"expected uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    height, width, _ = image.shape
    lines = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 9)), (b"IEND", b""))
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body
