"""Saliency of the last decision of a greedy episode, one row a run."""

from typing import Any

from arcade_torch.tools.analysis.checkpoints import load_labelled
from arcade_torch.tools.analysis.episode_saliency import episode_window, explain
from arcade_torch.tools.analysis.saliency_figure import saliency_figure
from arcade_torch.tools.figures.registry import Made, Request
from arcade_torch.tools.figures.runs import find_runs
from arcade_torch.tools.figures.style import TWIN_NAMES, drawing, footnote, save

SHOW = 8
MAX_STEPS = 30
"""Longest episode, as in the paper's figures."""


def make(request: Request) -> Made:
    """The figure ``saliency``: the first seed of every agent and task."""
    found = find_runs(request.runs)
    rows = []
    arrays: dict[str, Any] = {}
    numbers: list[dict[str, Any]] = []
    groups = found.groups()
    for index, runs in enumerate(groups.values()):
        agent, label = load_labelled(runs[0].folder.path)
        window = episode_window(agent, max_steps=MAX_STEPS)
        result = explain(agent, window)
        title = f"{label.agent}, {label.game} ({TWIN_NAMES[label.observability]}), seed {label.seed}"
        frames = window.frames.cpu().numpy()
        rows.append((title, frames, result.maps))
        arrays |= {f"frames_{index}": frames, f"maps_{index}": result.maps, f"per_frame_{index}": result.per_frame}
        shares = result.shares()
        numbers += [{"row": index, "run": title, "step": t, "share": shares[t]} for t in range(len(shares))]
        if request.progress is not None:
            request.progress(label.path.name, index + 1, len(groups))
    with drawing(request.style):
        figure = saliency_figure(rows, show=SHOW)
        footnote(
            figure,
            f"n = 1 episode a row, decision at n; sum over actions of |gradient|^2, {result.target}, brightness is its "
            "square root; no interval",
        )
        return Made(save(figure, request.out / "saliency", numbers, arrays), found.notes)
