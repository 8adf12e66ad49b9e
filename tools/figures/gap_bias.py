"""Gap against Bias: one point an agent; right and down is better."""

from typing import Any

import numpy as np

from arcade_torch.tools.analysis.bootstrap import Interval
from arcade_torch.tools.figures.registry import Made, Request
from arcade_torch.tools.figures.style import MARKERS, NEUTRAL, agent_colour, drawing, footnote, inches, save, whiskers
from arcade_torch.tools.figures.tables import is_person, table_of


def make(request: Request) -> Made:
    """The figure ``gap-bias``."""
    table, notes, under, text = table_of(request)
    points = [(row.agent, row.bias, row.gap) for row in table.rows if not is_person(row.agent)]
    with drawing(request.style) as plt:
        figure, axis = plt.subplots(figsize=inches(request.style, 7.4, 5.4), layout="constrained")
        scatter(axis, points)
        footnote(figure, under)
        return Made(save(figure, request.out / "gap-bias", table.table()), notes, text)


def scatter(axis: Any, points: list[tuple[str, Interval, Interval]]) -> None:
    """Draw (name, Bias, Gap) with both intervals and the name beside each point.

    Args:
        axis: of matplotlib.
        points: one an agent.
    """
    for place, (agent, bias, gap) in enumerate(points):
        ends = np.array([[bias.low, bias.value, bias.high], [gap.low, gap.value, gap.high]])
        colour = agent_colour(agent, place)
        errors = [whiskers(*row[:, None]) if np.isfinite(row).all() else None for row in ends]
        axis.errorbar(
            bias.value,
            gap.value,
            yerr=errors[1],
            xerr=errors[0],
            fmt=MARKERS[place % len(MARKERS)],
            color=colour,
            capsize=2,
            lw=1,
        )
        axis.annotate(
            agent, (bias.value, gap.value), (6, 5), textcoords="offset points", color=colour, fontsize="small"
        )
    axis.axhline(0.0, color=NEUTRAL, lw=1, ls="--")
    axis.axvline(0.0, color=NEUTRAL, lw=1, ls="--")
    axis.margins(0.15)
    axis.grid(True, axis="both")
    axis.set_xlabel("Memory Bias\n(MDP - memory-free MDP, normalised return)")
    axis.set_ylabel("Observability Gap\n(MDP - POMDP, normalised return)")
