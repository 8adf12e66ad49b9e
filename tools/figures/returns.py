"""POMDP return, Gap and Bias of every agent, with all games and without each of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from arcade_torch.tools.analysis.gap_bias import AgentRow, GapBias
from arcade_torch.tools.figures.registry import Made, Request
from arcade_torch.tools.figures.style import (
    MARKERS,
    NEUTRAL,
    agent_colour,
    drawing,
    footnote,
    inches,
    save,
    whiskers,
)
from arcade_torch.tools.figures.tables import is_person, table_of

PANELS = (
    ("pomdp", "POMDP return", "normalised return"),
    ("gap", "Observability Gap", "MDP - POMDP"),
    ("bias", "Memory Bias", "MDP - memory-free MDP"),
)


def make(request: Request) -> Made:
    """Two figures: ``returns`` and, with several games, ``returns-without`` (one game left out at a time)."""
    table, notes, under, text = table_of(request)
    files = []
    with drawing(request.style) as plt:
        figure = bars(plt, table.rows, under, request.style)
        files += save(figure, request.out / "returns", table.table())
        if table.without:
            figure = without_each(plt, table, under, request.style)
            files += save(figure, request.out / "returns-without")
    return Made(files, notes, text)


def bars(plt: Any, rows: Sequence[AgentRow], under: str, style: str) -> Any:
    """Three panels of bars, one bar an agent.

    Args:
        plt: from `drawing`.
        rows: agents, left to right.
        under: footnote.
        style: light or print.
    """
    figure, axes = plt.subplots(1, 3, figsize=inches(style, 12.5, 4.2), layout="constrained")
    for axis, (name, title, unit) in zip(axes, PANELS, strict=True):
        chosen = [row for row in rows if not (name == "bias" and is_person(row.agent))]
        ends = np.array([[getattr(row, name).low, getattr(row, name).value, getattr(row, name).high] for row in chosen])
        colours = [agent_colour(row.agent, place) for place, row in enumerate(chosen)]
        places = np.arange(len(chosen))
        axis.bar(places, ends[:, 1], 0.72, color=colours)
        known = np.isfinite(ends[:, 0])
        axis.errorbar(
            places[known], ends[known, 1], whiskers(*ends[known].T), fmt="none", ecolor="black", capsize=3, lw=1
        )
        axis.set_xticks(places, [row.agent for row in chosen], rotation=35, ha="right", rotation_mode="anchor")
        axis.set_title(title)
        axis.set_ylabel(unit)
        if name != "pomdp":
            axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
    footnote(figure, under)
    return figure


def without_each(plt: Any, table: GapBias, under: str, style: str) -> Any:
    """The same three numbers with one game left out at a time; the first column has all games.

    Args:
        plt: from `drawing`.
        table: with ``without``.
        under: footnote.
        style: light or print.
    """
    columns = [("all games", table.rows), *((f"no {game}", rows) for game, rows in table.without.items())]
    figure, axes = plt.subplots(3, 1, figsize=inches(style, 12.5, 10), sharex=True, layout="constrained")
    agents = [row.agent for row in table.rows]
    offsets = np.linspace(-0.34, 0.34, len(agents))
    for axis, (name, title, unit) in zip(axes, PANELS, strict=True):
        for place, agent in enumerate(agents):
            if name == "bias" and (is_person(agent) or agent == table.baseline):
                continue
            values = [getattr(next(row for row in rows if row.agent == agent), name) for _, rows in columns]
            ends = np.array([[value.low, value.value, value.high] for value in values])
            x = np.arange(len(columns)) + offsets[place]
            axis.errorbar(
                x,
                ends[:, 1],
                whiskers(*ends.T) if np.isfinite(ends).all() else None,
                fmt=MARKERS[place % len(MARKERS)],
                lw=1,
                color=agent_colour(agent, place),
                label=agent,
            )
        axis.set_title(title, loc="left")
        axis.set_ylabel(unit)
        axis.axvline(0.5, color=NEUTRAL, lw=0.8)
        if name != "pomdp":
            axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
    axes[0].legend(ncols=len(agents), loc="lower center", bbox_to_anchor=(0.5, 1.08))
    axes[-1].set_xticks(np.arange(len(columns)), [name for name, _ in columns], rotation=25, ha="right")
    footnote(figure, under)
    return figure
