"""Saliency of the last decision of a greedy episode: a row of frames a run, heat over each."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from arcade_torch.tools.analysis.checkpoints import checkpoints_of, load_labelled, with_names
from arcade_torch.tools.analysis.pixel_saliency import Saliency, saliency
from arcade_torch.tools.analysis.resolve import episode_window
from arcade_torch.tools.analysis.windows import Window
from arcade_torch.tools.figures import registry
from arcade_torch.tools.figures.registry import Made, Progress
from arcade_torch.tools.figures.style import TWIN_NAMES, drawing, footnote, save
from arcade_torch.tools.optional import need
from arcade_torch.tools.runs import find_runs
from arcade_torch.tools.tables import Table

SIGMA_PX = 6.0
"""Width of the smoothing at 128 px, as in the paper's figures; scales with the frame."""

Row = tuple[str, NDArray[np.uint8], NDArray[np.float32]]
"""Title, frames uint8 [T, H, W, 3], maps float [T, H, W]; ends at the explained step."""


@dataclass
class Options(registry.Options):
    """Options of the figure."""

    seed: int = 0
    """Of the episode."""
    max_steps: int = 30
    """Longest episode; the paper's figures have 30."""
    show: int = 8
    """How many of the last frames are drawn."""
    observability: Literal["full", "partial"] | None = None
    """Another twin than the agent was trained on."""
    reduce: Literal["per_action", "sum"] = "per_action"
    """Sum of the actions' norms (the paper), or norm of the sum over actions."""
    norm: Literal["l2sq", "l2", "l1"] = "l2sq"
    """Norm over colour channels."""
    target: Literal["auto", "q", "logits", "probs", "value"] = "auto"
    """What is differentiated; Q-values, or a policy's probabilities, by default."""


def make(options: Options, progress: Progress | None) -> Made:
    """The figure ``saliency``: every run that is named, and of studies the first seed of every agent and task."""
    options.checkpoints()
    if options.show < 1 or options.max_steps < 1:
        raise ValueError(f"--show and --max-steps must be at least 1, got {options.show} and {options.max_steps}")
    paths, notes = checkpoints_of(options.runs)
    first = [runs[0].path for runs in find_runs(paths).groups().values()] if _are_runs(paths) else paths
    paths = [path for path in paths if path in first or path in options.runs]
    measured, windows = [], []
    for done, path in enumerate(paths, start=1):
        agent, label = load_labelled(path, options.observability)
        windows.append(
            episode_window(agent, seed=options.seed, observability=options.observability, max_steps=options.max_steps)
        )
        measured.append((label, explain(agent, windows[-1], options)))
        if progress is not None:
            progress("saliency", done, len(paths))
    rows: list[Row] = []
    arrays: dict[str, Any] = {}
    numbers: list[dict[str, Any]] = []
    for index, ((label, found), window) in enumerate(zip(with_names(measured), windows, strict=True)):
        title = f"{label.agent}, {label.game} ({TWIN_NAMES[label.observability]}), seed {label.seed}"
        frames, shares = window.frames.cpu().numpy(), found.shares()
        rows.append((title, frames, found.maps))
        arrays |= {f"title_{index}": np.array(title), f"frames_{index}": frames, f"maps_{index}": found.maps}
        arrays |= {f"per_frame_{index}": found.per_frame, f"action_{index}": window.action.cpu().numpy()}
        numbers += [{"row": index, "run": title, "step": t, "share": shares[t]} for t in range(len(shares))]
    cells = [(title, len(frames), f"{100 * _last(numbers, i):.1f} %") for i, (title, frames, _) in enumerate(rows)]
    with drawing(options.style):
        figure = saliency_figure(rows, show=options.show)
        footnote(
            figure,
            f"n = 1 episode a row, decision at n; {options.reduce}, {options.norm} of the gradient, "
            f"{measured[0][1].target}, brightness is its square root; no interval",
        )
        files = save(options, "saliency", figure, numbers, arrays)
    table = Table("gradient of the last decision", ("run", "frames", "on the last frame"), cells)
    return Made(files, notes, [table], numbers)


def _are_runs(paths: Sequence[Any]) -> bool:
    return len(paths) > 1 and all((path / "eval.json").is_file() for path in paths)


def _last(numbers: Sequence[dict[str, Any]], row: int) -> float:
    return float([number["share"] for number in numbers if number["row"] == row][-1])


def explain(agent: Any, window: Window, options: Options | None = None) -> Saliency:
    """Saliency of the last decision of a window."""
    how = options or Options()
    return saliency(
        agent,
        window.frames,
        window.last_action,
        window.is_init,
        window.state,
        reduce=how.reduce,
        norm=how.norm,
        target=how.target,
    )


def saliency_figure(rows: Sequence[Row], *, show: int = 8, sigma_px: float | None = None, alpha: float = 0.5) -> Any:
    """Draw frames with their saliency maps, a row a trajectory.

    Args:
        rows: one ``(title, frames, maps)`` each, see `Row`.
        show: how many of the last frames are drawn.
        sigma_px: smoothing in pixels; 6 at 128 px by default.
        alpha: weight of the heat over the frame.

    Returns:
        A matplotlib figure. Each row has a scale of its own, and says the value that is drawn brightest.

    Raises:
        MissingPackage: matplotlib is not installed.
    """
    plt = need("matplotlib.pyplot")
    columns = min(show, max(frames.shape[0] for _, frames, _ in rows))
    figure = plt.figure(figsize=(1.7 * columns, 2.2 * len(rows)), layout="constrained")
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for part, (title, frames, maps) in zip(parts, rows, strict=True):
        peak = plot(frames, maps, part.subplots(1, columns, squeeze=False)[0], sigma_px, alpha)
        part.suptitle(f"{title}; brightest {peak:.1e}", fontsize=9, x=0.01, ha="left")
    return figure


def plot(
    frames: NDArray[np.uint8],
    maps: NDArray[np.floating],
    axes: Sequence[Any],
    sigma_px: float | None = None,
    alpha: float = 0.5,
    below: NDArray[np.float64] | None = None,
) -> float:
    """Draw the last frames of a trajectory, heat over each, on one scale.

    The heat is the square root of the smoothed map: that makes a frame visible that has a hundredth of the brightest.
    """
    sigma = SIGMA_PX * frames.shape[1] / 128 if sigma_px is None else sigma_px
    blur = need("scipy.ndimage").gaussian_filter
    soft = blur(np.asarray(maps, np.float64), (0, sigma, sigma), truncate=3.0) if sigma else np.asarray(maps)
    peak = float(soft.max(initial=0.0))
    heat = np.sqrt(soft / peak) if peak > 0 else soft
    total = len(frames)
    chosen = list(range(max(0, total - len(axes)), total))
    for axis in axes:
        axis.set_axis_off()
    for axis, t in zip(axes[len(axes) - len(chosen) :], chosen, strict=True):
        axis.imshow(frames[t], interpolation="nearest")
        axis.imshow(heat[t], cmap="afmhot", vmin=0, vmax=1, alpha=alpha, interpolation="nearest")
        share = "" if below is None else f": {below[t]:.1f} %"
        axis.set_title(f"$o_{{{step_title(t, total - 1)}}}${share}", fontsize=9)
    return peak


def step_title(t: int, n: int) -> str:
    """How frame t of a window that ends at n is called.

    Example:
        >>> step_title(3, 5), step_title(5, 5)
        ('n-2', 'n')
    """
    return "n" if t == n else f"n-{n - t}"
