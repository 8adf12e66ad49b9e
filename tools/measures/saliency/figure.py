"""Saliency of the last decision of a greedy episode: a row of frames a run, heat over each."""

import math
import textwrap
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arcade_torch.agents.checked import require
from arcade_torch.envs_jax.validation import kind_of
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import Made, Picture, Progress
from arcade_torch.tools.figures.style import TWIN_NAMES, new_figure, panels, png, rows_of
from arcade_torch.tools.files import Table
from arcade_torch.tools.measures.checkpoints import checkpoints_of, measure_run, measure_runs
from arcade_torch.tools.measures.frames import pictures
from arcade_torch.tools.measures.saliency import SaliencyOptions
from arcade_torch.tools.measures.saliency.measure import EpisodeSaliency, episode_saliency
from arcade_torch.tools.measures.section import Cells
from arcade_torch.tools.options import at_least

SIGMA_PX = 6.0  # width of the smoothing at 128 px, as in the paper's figures; scales with the frame
# of a report: frames of a strip; episodes that are tried until one has as many
SHOW = 8
TRIES = 10

SATURATED = 0.99
"""From this probability of one action on the softmax of a policy is flat: its slope, ``p (1 - p)``,
is a twenty-fifth of the steepest and less.
"""
VANISHING: Mapping[str, float] = {"l2sq": 1e-10, "l1": 2e-3}
"""Below this sum of squared gradients, or of their sizes, an episode has none to speak of: if all
values of a frame of 128 pixels move by 1 (of 255), then, to first order, no output moves by more
than 0.003.
"""
SUMMED: Mapping[str, str] = {"l2sq": "squared gradients", "l1": "gradients"}
INSTEAD = "take --target logits, or counterfactual recall (analyze counterfactual)"
"""What a note on vanishing gradients advises."""

# title, frames [T, *frame] of any kind, maps [T, H, W] up to step n
Row = tuple[str, Any, NDArray[np.float32]]


def rows(options: SaliencyOptions, progress: Progress | None) -> Made:
    """The figure ``saliency``: every run that is named, and of studies the first seed of every
    agent and task.
    """
    at_least(options, show=1, max_steps=1)
    paths, notes = checkpoints_of(options.runs)
    if len(paths) > 1 and all((path / "eval.json").is_file() for path in paths):
        first = [seeds[0].path for seeds in find_runs(paths).groups().values()]
        paths = [path for path in paths if path in first or path in options.runs]
    measured = measure_runs(paths, episode_saliency, vars(options), progress)
    drawn = list[Row]()
    cells = list[tuple[str, int, str]]()
    arrays = dict[str, Any]()
    numbers = list[dict[str, Any]]()
    for index, (label, episode) in enumerate(measured):
        twin = TWIN_NAMES[label.observability]
        title = f"{label.agent}, {label.game} ({twin}), seed {label.seed}"
        shares = episode.shares()
        drawn.append((title, episode.frames, episode.maps))
        cells.append((title, len(shares), f"{100 * shares[-1]:.1f} %"))
        warning = no_gradient(episode, options.norm)
        if warning:
            notes.append(f"{title}: shares of the gradient say nothing: {warning}; {INSTEAD}")
        numbers += rows_of(row=index, run=title, step=np.arange(len(shares)), share=shares)
        arrays[f"title_{index}"] = np.array(title)
        arrays[f"frames_{index}"] = episode.frames
        arrays[f"maps_{index}"] = episode.maps
        arrays[f"per_frame_{index}"] = episode.per_frame
        arrays[f"action_{index}"] = episode.action
    note = (
        f"n = 1 episode a row, decision at n; {options.reduce}, {options.norm} of the gradient, "
        f"{measured[0][1].target}, brightness is its square root; no interval"
    )
    figure = saliency_figure(drawn, show=options.show, figure=new_figure())
    picture = Picture("saliency", figure, note, numbers, arrays)
    table = Table("gradient of the last decision", ("run", "frames", "on the last frame"), cells)
    return Made([picture], notes, [table])


def saliency_figure(
    rows: Sequence[Row], *, show: int = 8, white: float | None = None, figure: Any = None
) -> Any:
    """Draw frames with their saliency maps, a row a trajectory; each has a scale of its own, whose
    top it names.

    Args:
        rows: one ``(title, frames, maps)`` each, see `Row`; frames as `saliency` takes them.
        show: how many of the last frames are drawn.
        white: the value of a white pixel, 255 for whole numbers and 1 for floats by default.
        figure: an empty figure to draw into; a new one of ``matplotlib.pyplot`` by default, which
            notebooks show.

    Returns:
        A matplotlib figure.
    """
    if not isinstance(rows, Sequence) or not all(_is_row(row) for row in rows):
        raise TypeError(f"rows must be a list of (title, frames, maps); got {kind_of(rows)}")
    require(len(rows) > 0, "rows", list(rows), "one at least")
    require(show >= 1, "show", show, "at least 1")
    for title, frames, maps in rows:
        _check_maps(title, np.shape(frames), maps)
    longest = max(len(frames) for _, frames, _ in rows)
    columns = min(show, longest)
    figure = need("matplotlib.pyplot").figure() if figure is None else figure
    figure.set_size_inches(1.7 * columns, 2.2 * len(rows))
    figure.set_layout_engine("constrained")
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for part, (title, frames, maps) in zip(parts, rows, strict=True):
        axes = part.subplots(1, columns, squeeze=False)[0]
        peak = plot(frames, maps, axes, white=white)
        look = {"fontsize": "small", "x": 0.01, "ha": "left", "parse_math": False}
        above = part.suptitle(f"{title}; brightest {peak:.1e}", **look)
        letters = int(figure.get_figwidth() * 72 / (0.68 * above.get_fontsize()))
        above.set_text(textwrap.fill(above.get_text(), letters, break_on_hyphens=False))
    return figure


def _is_row(row: Any) -> bool:
    """Whether it has the three parts of a `Row`, the first a title."""
    return isinstance(row, tuple | list) and len(row) == 3 and isinstance(row[0], str)


def _check_maps(title: str, frames: Sequence[int], maps: NDArray[np.floating]) -> None:
    """Refuse maps that are not those of frames of a shape [T, *frame], or hold NaN."""
    allowed = [list(frames)]
    if len(frames) == 4:  # channels last, or first
        allowed = [[*frames[:3]], [frames[0], *frames[2:]]]
    name = f"the maps of {title!r}"
    fits = list(np.shape(maps)) in allowed
    require(fits, name, list(np.shape(maps)), " or ".join(map(str, allowed)))
    require(bool(np.isfinite(maps).all()), name, "NaN or infinity", "finite")


def plot(
    frames: Any,
    maps: NDArray[np.floating],
    axes: Sequence[Any],
    sigma_px: float | None = None,
    below: NDArray[np.float64] | None = None,
    white: float | None = None,
) -> float:
    """Draw the last frames of a trajectory, heat over each, on one scale; returns the value that is
    brightest.

    The heat is the square root of the smoothed map: that makes a frame visible that has a hundredth
    of the brightest.
    """
    has_channels_last = np.ndim(frames) == 4 and frames.shape[1:3] == maps.shape[1:3]
    frames = pictures(frames, "last" if has_channels_last else "first", white)
    maps = np.reshape(maps, frames.shape[:3])
    sigma = SIGMA_PX * frames.shape[1] / 128 if sigma_px is None else sigma_px
    blur = need("scipy.ndimage").gaussian_filter
    soft = np.asarray(maps)
    if sigma:
        soft = blur(np.asarray(maps, np.float64), (0, sigma, sigma), truncate=3.0)
    peak = float(soft.max(initial=0.0))
    heat = np.sqrt(soft / peak) if peak > 0 else soft
    n = len(frames) - 1
    for axis, t in zip(axes, range(n + 1 - len(axes), n + 1), strict=True):
        axis.set_axis_off()
        if t >= 0:
            axis.imshow(frames[t], interpolation="nearest")
            axis.imshow(heat[t], cmap="afmhot", vmin=0, vmax=1, alpha=0.5, interpolation="nearest")
            name = "n" if t == n else f"n-{n - t}"
            share = "" if below is None else f": {below[t]:.1f} %"
            axis.set_title(f"$o_{{{name}}}${share}", fontsize="small", parse_math=True)
    return peak


def saliency_strips(cells: Cells, progress: Progress | None) -> list[dict[str, Any]]:
    """Frames under heat of every cell, from its first seed; with the value drawn brightest and the
    last share (%). Where gradients vanish a warning, and the same by the logits.
    """
    strips = []
    for done, ((agent, game, twin), paths) in enumerate(cells.items(), start=1):
        episode, by_logits = measure_strip(paths[0])
        logits = None if by_logits is None else _strip(by_logits)
        names = {"agent": agent, "game": game, "twin": twin}
        numbers = {"warning": no_gradient(episode), "logits": logits}
        strips.append(names | _strip(episode) | numbers)
        if progress is not None:
            progress("saliency", done, len(cells))
    return strips


def measure_strip(path: Path) -> tuple[EpisodeSaliency, EpisodeSaliency | None]:
    """The episode of a strip, and the same by the logits where its gradients vanish."""
    settings = {"show": SHOW, "tries": TRIES}
    _, episode = measure_run(path, episode_saliency, settings)
    if not no_gradient(episode) or episode.target != "probs":
        return episode, None
    _, by_logits = measure_run(path, episode_saliency, settings | {"target": "logits"})
    return episode, by_logits


def _strip(episode: EpisodeSaliency) -> dict[str, Any]:
    """The last frames of an episode under heat, as a picture, with its numbers."""
    shares = 100 * episode.shares()
    count = min(SHOW, len(episode.frames))
    lines = math.ceil(count / 4)
    columns = math.ceil(count / lines)
    figure, axes = panels(lines, columns, (0.9 * columns, 1.1 * lines))
    for axis in axes.flat[count:]:
        axis.set_axis_off()
    peak = plot(episode.frames, episode.maps, axes.flat[:count], below=shares)
    return {
        "frames": len(shares),
        "last_share": shares[-1],
        "peak": peak,
        "source": b64encode(png(figure)).decode("ascii"),
    }


def no_gradient(episode: EpisodeSaliency, norm: str = "l2sq") -> str:
    """Why the shares of an episode say nothing, or an empty text if they do; all else is as for
    `vanishing`.
    """
    return vanishing(episode.target, episode.output.max(), episode.per_frame.sum(), norm)


def vanishing(target: str, certainty: float, total: float, norm: str) -> str:
    """Why shares of gradients say nothing, or an empty text if they do.

    Args:
        target: what was differentiated.
        certainty: the largest output at the decision.
        total: the sum over frames.
        norm: with which it was computed; sums of others than those of `VANISHING` are not compared.
    """
    reasons = list[str]()
    if target == "probs" and certainty >= SATURATED:
        reasons.append(f"the policy is saturated, its best action has {certainty:.5f}")
    if norm in VANISHING and total < VANISHING[norm]:
        reasons.append(f"all {SUMMED[norm]} sum to {total:.0e}")
    return ", and ".join(reasons)
