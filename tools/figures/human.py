"""Returns of people on every task, beside those of the memory-free agent; from the paper's table only."""

import numpy as np

from arcade_torch.tools.analysis.normalise import DIFFICULTIES
from arcade_torch.tools.analysis.paper import PAPER_RETURNS, SEEDS
from arcade_torch.tools.figures.registry import Made, PaperOptions, Picture, Progress
from arcade_torch.tools.figures.style import TWIN_COLOURS, agent_colour, panels
from arcade_torch.tools.files import read_csv


def returns(options: PaperOptions, progress: Progress | None) -> Made:
    """The figure ``human``; runs are not looked at."""
    table = read_csv(PAPER_RETURNS)
    people = [row for row in table if row["model"] == "human"]
    machine = {(row["env"], row["difficulty"]): row for row in table if row["model"] == "MLP"}
    figure, axes = panels(2, 5, (12.5, 5.6), sharey=True)
    x = np.arange(len(DIFFICULTIES))
    for axis, game in zip(axes.flat, dict.fromkeys(row["env"] for row in people), strict=True):
        here = [row for row in people if row["env"] == game]
        for side, (colour, twin) in enumerate(zip(TWIN_COLOURS.values(), ("mdp", "pomdp"), strict=True)):
            places = x + (side - 0.5) * 0.36
            mean, std = ([float(row[f"{twin}_{what}"]) for row in here] for what in ("mean", "std"))
            style = {"fmt": "os"[side], "color": colour, "capsize": 2, "lw": 1.2}
            axis.errorbar(places, mean, std, label=f"people, {twin.upper()}", **style)
            plain = [float(machine[game, row["difficulty"]][f"{twin}_mean"]) for row in here]
            label = "memory-free agent" if side else None
            axis.plot(places, plain, "_", mew=2, color=agent_colour("mlp"), label=label)
        axis.axhline(0.0, color="#bbbbbb", lw=0.8)
        axis.set_xticks(x, DIFFICULTIES)
        axis.set_title(game)
    for axis in axes[:, 0]:
        axis.set_ylabel("return, not normalised")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    note = f"published; n = {SEEDS} people, bars: one standard deviation over people"
    notes = ["people cannot be measured again: --runs is not looked at"] if options.runs else []
    return Made([Picture("human", figure, note, people)], notes)
