"""Names of points: beside each, or of many agents a number at each, and a legend beside the panel
that names the numbers.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

LEGEND_LINES = 25
"""Of a column of the legend."""
_PANEL_PT = np.array((400.0, 300.0))  # about the size of a panel, in points
_NUMBER_PT = np.array((16.0, 9.0))  # and of a number
_LETTER_PT = 6.5  # width of a letter of a name
_LINE_PT = 11.0  # height of a name
_NAME_FROM_POINT_PT = (6.0, 5.0)
_DIRECTIONS = 16
_DISTANCES_PT = (10.0, 15.0, 21.0)  # of a number from its point; the nearer ones come first
_BARS_ALPHA = 0.35


def name_points(axis: Any, bars: Sequence[Any], agents: Sequence[str]) -> None:
    """Write the names of error bars' points beside them, in a panel whose limits are set; where
    points lie close, one above the other.
    """
    points = np.array([bar.lines[0].get_xydata()[0] for bar in bars]).reshape(-1, 2)
    x, y = _NAME_FROM_POINT_PT
    taken = list[tuple[float, float, float]]()
    for bar, agent, point, place in zip(bars, agents, points, _places(points, axis), strict=True):
        left = float(place[0]) + x
        right = left + _LETTER_PT * len(agent)
        up = 0.0
        while any(
            left < other_right
            and other_left < right
            and abs(float(place[1]) + up - other_bottom) < _LINE_PT
            for other_left, other_right, other_bottom in taken
        ):
            up += _LINE_PT
        taken.append((left, right, float(place[1]) + up))
        axis.annotate(
            agent,
            tuple(point),
            (x, y + up),
            textcoords="offset points",
            color=bar.lines[0].get_color(),
            fontsize="small",
        )


def number_points(axis: Any, bars: Sequence[Any], agents: Sequence[str]) -> None:
    """Number the points of error bars in a panel whose limits are set, and name the numbers in a
    legend, which the figure grows for.
    """
    for bar in bars:
        for part in (*bar.lines[1], *bar.lines[2]):
            part.set_alpha(_BARS_ALPHA)  # so that numbers can be read over them
    points = np.array([bar.lines[0].get_xydata()[0] for bar in bars])
    for place, offset in enumerate(_offsets(points, axis)):
        axis.annotate(
            str(place + 1),
            tuple(points[place]),
            tuple(offset),
            textcoords="offset points",
            color=bars[place].lines[0].get_color(),
            fontsize="small",
            ha="center",
            va="center",
        )
    names = [f"{number}  {agent}" for number, agent in enumerate(agents, 1)]
    columns = -(-len(names) // LEGEND_LINES)
    axis.legend(
        bars, names, loc="upper left", bbox_to_anchor=(1.01, 1.0), ncols=columns, fontsize="small"
    )
    figure = axis.figure
    letters = max(map(len, names))
    figure.set_figwidth(figure.get_figwidth() + columns * (0.5 + 0.085 * letters))


def _offsets(points: np.ndarray[Any, Any], axis: Any) -> list[np.ndarray[Any, Any]]:
    """Where the number of each point stands, from the point, so that it is far from all points and
    from the numbers before it.
    """
    places = _places(points, axis)
    angles = 2 * np.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    candidates = np.concatenate([distance * circle for distance in _DISTANCES_PT])
    taken = list(places)
    offsets = list[np.ndarray[Any, Any]]()
    for place in places:
        apart = (place + candidates)[:, None] - np.array(taken)
        room = np.min(np.max(np.abs(apart) / _NUMBER_PT, axis=2), axis=1)
        # more room than a number needs is no better
        best = int(np.argmax(np.minimum(room, 1.0)))
        offsets.append(candidates[best])
        taken.append(place + candidates[best])
    return offsets


def _places(points: np.ndarray[Any, Any], axis: Any) -> np.ndarray[Any, Any]:
    """Where points stand in their panel, in points of print."""
    low, high = np.transpose([axis.get_xlim(), axis.get_ylim()])
    places: np.ndarray[Any, Any] = (points - low) / (high - low) * _PANEL_PT
    return places
