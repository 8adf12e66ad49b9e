"""Saliency strips of a study: one greedy episode of each agent and twin, its last frames under heat."""

from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arcade_torch.tools.analysis.images import SIGMA_PX, overlay, png, scaled
from arcade_torch.tools.analysis.saliency_figure import last_frames, step_title
from arcade_torch.tools.files import write_bytes
from arcade_torch.tools.reports.chosen import Cell
from arcade_torch.tools.studies.folder import StudyFolder

SHOW = 8
EPISODES_TRIED = 10


@dataclass(frozen=True)
class Tile:
    """One frame of a strip: its picture as a data address, its name, its share of the gradient in percent."""

    source: str
    title: str
    share: float


@dataclass(frozen=True)
class Strip:
    """A row of tiles: whose they are, length of the episode, value drawn brightest, share on the last frame (%)."""

    agent: str
    game: str
    observability: str
    run: str
    frames: int
    peak: float
    last_share: float
    tiles: list[Tile]


def saliency_strips(
    folder: StudyFolder, cells: Sequence[Cell], progress: Callable[[str, int, int], None] | None = None
) -> list[Strip]:
    """One strip for each cell, from its first finished seed.

    The arrays are kept in ``analysis/saliency/RUN.npz`` and reused while the run's final evaluation is older.

    Args:
        folder: the study on disk.
        cells: whom to look into.
        progress: called with (what, done, total).
    """
    found = []
    for done, cell in enumerate(cells, start=1):
        found.append(_strip(cell, _arrays(folder, cell.runs[0])))
        if progress is not None:
            progress("saliency", done, len(cells))
    return found


def _arrays(folder: StudyFolder, run: Path) -> dict[str, NDArray[Any]]:
    file = folder.analysis / "saliency" / f"{run.name}.npz"
    if not (file.exists() and file.stat().st_mtime >= (run / "eval.json").stat().st_mtime):
        _compute(run, file)
    with np.load(file, allow_pickle=False) as kept:
        return {name: kept[name] for name in kept.files}


def _compute(run: Path, file: Path) -> None:
    """The first of some held-out episodes that fills a strip, else the longest of them."""
    from io import BytesIO

    from arcade_torch.agents import load
    from arcade_torch.tools.analysis.episode_saliency import episode_window, explain

    agent = load(run)
    windows = []
    for seed in range(EPISODES_TRIED):
        windows.append(episode_window(agent, seed=seed))
        if windows[-1].n + 1 >= SHOW:
            break
    window = max(windows, key=lambda item: item.n)
    found = explain(agent, window)
    buffer = BytesIO()
    np.savez_compressed(
        buffer,
        frames=window.frames.cpu().numpy(),
        maps=found.maps,
        per_frame=found.per_frame,
        output=found.output,
        action=window.action.cpu().numpy(),
        reward=window.reward.cpu().numpy(),
        seed=np.array(window.seed),
    )
    write_bytes(file, buffer.getvalue())


def _strip(cell: Cell, arrays: dict[str, NDArray[Any]]) -> Strip:
    frames, per_frame = arrays["frames"], arrays["per_frame"].astype(np.float64)
    total = per_frame.sum()
    shares = 100 * per_frame / total if total > 0 else per_frame
    keep = last_frames(len(frames), SHOW)
    heat, peak = scaled(arrays["maps"], SIGMA_PX * frames.shape[1] / 128)
    pictures = overlay(frames[keep], heat[keep])
    tiles = [
        Tile(data_address(png(picture)), step_title(t, len(frames) - 1), float(shares[t]))
        for t, picture in zip(keep, pictures, strict=True)
    ]
    return Strip(cell.agent, cell.game, cell.twin, cell.runs[0].name, len(frames), peak, float(shares[-1]), tiles)


def data_address(data: bytes) -> str:
    """PNG bytes as an address that stands in the page itself."""
    return "data:image/png;base64," + b64encode(data).decode("ascii")
