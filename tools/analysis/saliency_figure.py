"""The saliency figure: a row of frames a trajectory, heat over each."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arcade_torch.tools.analysis.images import SIGMA_PX, overlay, scaled
from arcade_torch.tools.optional import need


def last_frames(total: int, show: int) -> list[int]:
    """Indices of the last ``show`` of ``total`` frames."""
    return list(range(max(0, total - show), total))


def step_title(t: int, n: int) -> str:
    """How frame t of a window that ends at n is called: ``o_{n}`` counts back from the end.

    Example:
        >>> step_title(3, 5), step_title(5, 5)
        ('n - 2', 'n')
    """
    return "n" if t == n else f"n - {n - t}"


def saliency_figure(
    rows: Sequence[tuple[str, NDArray[np.uint8], NDArray[np.float32]]],
    *,
    show: int = 8,
    sigma_px: float | None = None,
    alpha: float = 0.5,
) -> Any:
    """Draw frames with their saliency maps.

    Args:
        rows: one ``(title, frames uint8 [T, H, W, 3], maps float [T, H, W])`` each; ends at the explained step.
        show: how many of the last frames are drawn.
        sigma_px: smoothing in pixels; 6 at 128 px by default.
        alpha: weight of the heat over the frame.

    Returns:
        A matplotlib figure. Each row has a scale of its own, and says the value that is drawn brightest.

    Raises:
        MissingPackage: matplotlib is not installed.
    """
    if "matplotlib.pyplot" not in sys.modules:  # a notebook keeps the windows it has chosen
        need("matplotlib").use("Agg")
    plt = need("matplotlib.pyplot")
    columns = min(show, max(frames.shape[0] for _, frames, _ in rows))
    figure = plt.figure(figsize=(1.7 * columns, 2.2 * len(rows)), layout="constrained")
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for part, (title, frames, maps) in zip(parts, rows, strict=True):
        sigma = SIGMA_PX * frames.shape[1] / 128 if sigma_px is None else sigma_px
        heat, peak = scaled(maps, sigma)
        picture = overlay(frames, heat, alpha)
        chosen = last_frames(frames.shape[0], columns)
        part.suptitle(f"{title}; brightest {peak:.1e}", fontsize=9, x=0.01, ha="left")
        axes = part.subplots(1, columns, squeeze=False)[0]
        for axis in axes:
            axis.set_axis_off()
        for axis, t in zip(axes[columns - len(chosen) :], chosen, strict=True):
            axis.imshow(picture[t], interpolation="nearest")
            axis.set_title(f"$o_{{{step_title(t, frames.shape[0] - 1).replace(' ', '')}}}$", fontsize=9)
    return figure


def save_saliency(
    path: Path,
    rows: Sequence[tuple[str, NDArray[np.uint8], NDArray[np.float32]]],
    extra: Mapping[str, Any],
    show: int = 8,
) -> list[Path]:
    """Write the figure and, beside it, the numbers behind it.

    Args:
        path: of the figure, ``.png``, ``.svg`` or ``.pdf``; the numbers go to the same name with ``.npz``.
        rows: as for `saliency_figure`.
        extra: further arrays for the npz file.
        show: how many of the last frames are drawn.

    Returns:
        The two paths.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = dict(extra)
    for index, (title, frames, maps) in enumerate(rows):
        arrays |= {f"title_{index}": np.array(title), f"frames_{index}": frames, f"maps_{index}": maps}
    numbers = path.with_suffix(".npz")
    np.savez_compressed(numbers, **arrays)
    figure = saliency_figure(rows, show=show)
    figure.savefig(path, dpi=150)
    need("matplotlib.pyplot").close(figure)
    return [path, numbers]
