"""Gap and Bias by depth and width of the memory."""

from dataclasses import dataclass, replace
from typing import Literal

from arcade_torch.tools.analysis.gap_bias import gap_and_bias
from arcade_torch.tools.figures import gap_bias, registry
from arcade_torch.tools.figures.registry import Made, Progress
from arcade_torch.tools.figures.style import drawing, footnote, inches, save, seeds_note
from arcade_torch.tools.runs import agent_names, find_runs, is_baseline


@dataclass
class Options(registry.Options):
    """Options of the figure."""

    metric: Literal["eval_final", "train_max_ewm"] = "eval_final"
    """Score of a run."""
    baseline: str = "mlp"
    """The memory-free agent."""
    confidence: float = 0.95
    """Of the intervals."""


def make(options: Options, progress: Progress | None) -> Made:
    """The figure ``size-sweep``: a panel a game; agents are named LAYERSxWIDTH, the memory-free one without."""
    found = find_runs(options.runs)
    sized = agent_names(found.names, sized=True)
    names = {key: name if is_baseline(name, options.baseline) else sized[key] for key, name in found.names.items()}
    scores = [
        replace(score, agent=names[run.key])
        for run, score in zip(found.runs, found.scores(options.metric), strict=True)
    ]
    notes, rows, panels = list(found.notes), [], []
    for game in dict.fromkeys(score.game for score in scores):
        here = [score for score in scores if score.game == game]
        try:
            table = gap_and_bias(here, metric=options.metric, baseline=options.baseline, confidence=options.confidence)
        except ValueError as error:
            notes.append(f"left out, {game}: {error}")
            continue
        panels.append((game, table))
        rows += [row | {"game": game} for row in table.table()]
    if not panels:
        raise ValueError(f"no size sweep in these runs: {notes[-1]}")
    if len({row["agent"] for row in rows}) < 3:
        notes.append("a single size beside the memory-free agent: vary --network-option layers or hidden_size")
    with drawing(options.style) as plt:
        size = inches(options.style, 7.2 * len(panels), 5.4)
        figure, axes = plt.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
        for axis, (game, table) in zip(axes[0], panels, strict=True):
            gap_bias.plot(table.rows, axis)
            axis.set_title(game)
        seeds = [int(row["seeds"]) for row in rows]
        footnote(figure, f"labels: layers x width; {options.metric}, {seeds_note(seeds, options.confidence)}")
        return Made(save(options, "size-sweep", figure, rows), notes, rows=rows)
