"""Gap and Bias by depth and width of the memory."""

from typing import Any

from arcade_torch.tools.analysis.gap_bias import gap_and_bias
from arcade_torch.tools.figures.gap_bias import scatter
from arcade_torch.tools.figures.registry import Made, Request
from arcade_torch.tools.figures.runs import Run, find_runs
from arcade_torch.tools.figures.style import drawing, footnote, inches, save, seeds_note


def make(request: Request) -> Made:
    """The figure ``size-sweep``: a panel a game; agents are named LAYERSxWIDTH."""
    found = find_runs(request.runs)
    games = list(dict.fromkeys(run.game for run in found.runs))
    notes, rows, panels = list(found.notes), [], []
    for game in games:
        scores = [run.score(request.metric, sized(run, request.baseline)) for run in found.runs if run.game == game]
        try:
            table = gap_and_bias(
                scores, metric=request.metric, baseline=request.baseline, confidence=request.confidence
            )
        except ValueError as error:
            notes.append(f"left out, {game}: {error}")
            continue
        panels.append((game, table))
        rows += [row | {"game": game} for row in table.table()]
    if not panels:
        raise ValueError(f"no size sweep in these runs: {notes[-1]}")
    if len({row["agent"] for row in rows}) < 3:
        notes.append("a single size beside the memory-free agent: vary --network-option layers or hidden_size")
    with drawing(request.style) as plt:
        size = inches(request.style, 7.2 * len(panels), 5.4)
        figure, axes = plt.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
        for axis, (game, table) in zip(axes[0], panels, strict=True):
            scatter(axis, [(row.agent, row.bias, row.gap) for row in table.rows])
            axis.set_title(game)
        seeds = [int(row["seeds"]) for row in rows]
        footnote(figure, f"labels: layers x width; {request.metric}, {seeds_note(seeds, request.confidence)}")
        return Made(save(figure, request.out / "size-sweep", rows), notes)


def sized(run: Run, baseline: str) -> str:
    """Name of an agent with its size, ``lru 2x512``; the memory-free agent keeps its name."""
    if run.agent == baseline:
        return run.agent
    layers, width = size_of(run.config)
    return f"{run.agent} {layers}x{width}"


def size_of(config: dict[str, Any]) -> tuple[int, int]:
    """Layers and width of the memory block of a run: its own options, else those of its network preset."""
    from arcade_torch.models.networks import PRESETS

    base = PRESETS[str(config.get("network", "paper"))]
    options = dict(config.get("network_options") or {})
    return int(options.get("layers", base.layers)), int(options.get("hidden_size", base.hidden_size))
