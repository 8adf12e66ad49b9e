"""Returns of people on every task, beside those of the memory-free agent; from the paper's table only."""

from dataclasses import dataclass

import numpy as np

from arcade_torch.tools.analysis.normalise import DIFFICULTIES
from arcade_torch.tools.analysis.paper import PAPER_RETURNS, SEEDS
from arcade_torch.tools.figures import registry
from arcade_torch.tools.figures.registry import Made, Progress
from arcade_torch.tools.figures.style import TWIN_COLOURS, agent_colour, drawing, footnote, inches, save
from arcade_torch.tools.files import read_csv


@dataclass
class Options(registry.Options):
    """Options of the figure."""

    paper: bool = False
    """The paper's table; there is no other."""


def make(options: Options, progress: Progress | None) -> Made:
    """The figure ``human``; runs are not looked at."""
    rows = read_csv(PAPER_RETURNS)
    people = [row for row in rows if row["model"] == "human"]
    machine = {(row["env"], row["difficulty"]): row for row in rows if row["model"] == "MLP"}
    games = list(dict.fromkeys(row["env"] for row in people))
    notes = ["people cannot be measured again: --runs is not looked at"] if options.runs else []
    with drawing(options.style) as plt:
        size = inches(options.style, 12.5, 5.6)
        figure, axes = plt.subplots(2, 5, figsize=size, sharey=True, layout="constrained")
        for axis, game in zip(axes.flat, games, strict=True):
            here = [row for row in people if row["env"] == game]
            x = np.arange(len(here))
            for side, (twin, column) in enumerate((("full", "mdp"), ("partial", "pomdp"))):
                places = x + (side - 0.5) * 0.36
                axis.errorbar(
                    places,
                    [float(row[f"{column}_mean"]) for row in here],
                    [float(row[f"{column}_std"]) for row in here],
                    fmt="os"[side],
                    color=TWIN_COLOURS[twin],
                    capsize=2,
                    lw=1.2,
                    label=f"people, {column.upper()}",
                )
                axis.plot(
                    places,
                    [float(machine[game, row["difficulty"]][f"{column}_mean"]) for row in here],
                    "_",
                    mew=2,
                    color=agent_colour("mlp"),
                    label="memory-free agent" if side else None,
                )
            axis.axhline(0.0, color="#bbbbbb", lw=0.8)
            axis.set_xticks(x, DIFFICULTIES)
            axis.set_title(game)
        for axis in axes[:, 0]:
            axis.set_ylabel("return, not normalised")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
        footnote(figure, f"published; n = {SEEDS} people, bars: one standard deviation over people")
        return Made(save(options, "human", figure, people), notes, rows=people)
