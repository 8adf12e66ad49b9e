"""POMDP return, Gap and Bias of every agent, with all games and without each of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.gap_bias import AgentRow, GapBias
from arcade_torch.tools.figures.gap_bias import is_person, table_of
from arcade_torch.tools.figures.registry import Made, Progress, ScoreOptions
from arcade_torch.tools.figures.style import MARKERS, NEUTRAL, agent_colours, drawing, footnote, inches, save, whiskers

Options = ScoreOptions
PANELS = {
    "mdp": ("MDP return", "normalised return"),
    "pomdp": ("POMDP return", "normalised return"),
    "gap": ("Observability Gap", "MDP - POMDP"),
    "bias": ("Memory Bias", "MDP - memory-free MDP"),
}
DRAWN = ("pomdp", "gap", "bias")


def make(options: ScoreOptions, progress: Progress | None) -> Made:
    """Two figures: ``returns`` and, with several games, ``returns-without`` (one game left out at a time)."""
    options.check_folder()
    made, table, under = table_of(options)
    with drawing(options.style) as plt:
        figure, axes = plt.subplots(1, 3, figsize=inches(options.style, 12.5, 4.2), layout="constrained")
        for axis, name in zip(axes, DRAWN, strict=True):
            plot(table.rows, axis, name)
        footnote(figure, under)
        made.files += save(options, "returns", figure, made.rows)
        if table.without:
            made.files += save(options, "returns-without", without_each(plt, table, under, options.style))
    return made


def plot(rows: Sequence[AgentRow], axis: Any, name: str) -> None:
    """Draw one number of every agent as a bar with its interval."""
    chosen = [row for row in rows if not (name == "bias" and is_person(row.agent))]
    ends = np.array([[getattr(row, name).low, getattr(row, name).value, getattr(row, name).high] for row in chosen])
    colours = agent_colours([row.agent for row in rows])
    places = np.arange(len(chosen))
    axis.bar(places, ends[:, 1], 0.72, color=[colours[row.agent] for row in chosen])
    known = np.isfinite(ends[:, 0])
    axis.errorbar(places[known], ends[known, 1], whiskers(*ends[known].T), fmt="none", ecolor="black", capsize=3, lw=1)
    axis.set_xticks(places, [row.agent for row in chosen], rotation=35, ha="right", rotation_mode="anchor")
    title, unit = PANELS[name]
    axis.set_title(title)
    axis.set_ylabel(unit)
    if name in ("gap", "bias"):
        axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")


def without_each(plt: Any, table: GapBias, under: str, style: str) -> Any:
    """The same three numbers with one game left out at a time; the first column has all games."""
    columns = [("all games", table.rows), *((f"no {game}", rows) for game, rows in table.without.items())]
    figure, axes = plt.subplots(3, 1, figsize=inches(style, 12.5, 10), sharex=True, layout="constrained")
    agents = [row.agent for row in table.rows]
    offsets = np.linspace(-0.34, 0.34, len(agents))
    for axis, name in zip(axes, DRAWN, strict=True):
        for place, agent in enumerate(agents):
            if name == "bias" and (is_person(agent) or agent == table.baseline):
                continue
            values = [getattr(next(row for row in rows if row.agent == agent), name) for _, rows in columns]
            ends = np.array([[value.low, value.value, value.high] for value in values])
            errors = whiskers(*ends.T) if np.isfinite(ends).all() else None
            x, mark = np.arange(len(columns)) + offsets[place], MARKERS[place % len(MARKERS)]
            axis.errorbar(x, ends[:, 1], errors, fmt=mark, lw=1, color=agent_colours(agents)[agent], label=agent)
        title, unit = PANELS[name]
        axis.set_title(title, loc="left")
        axis.set_ylabel(unit)
        axis.axvline(0.5, color=NEUTRAL, lw=0.8)
        if name != "pomdp":
            axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
    axes[0].legend(ncols=len(agents), loc="lower center", bbox_to_anchor=(0.5, 1.08))
    axes[-1].set_xticks(np.arange(len(columns)), [name for name, _ in columns], rotation=25, ha="right")
    footnote(figure, under)
    return figure
