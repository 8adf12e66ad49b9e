"""Charts as inline SVG that take their colours from the page, so that they follow its light and dark form."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TOP = 30  # of charts with rows


@dataclass(frozen=True)
class Box:
    """Size of a chart and its margins, in units of its own; whether lines are named at their right ends."""

    width: int
    height: int
    left: int
    right: int
    top: int
    bottom: int
    named: bool

    def x(self, share: float) -> float:
        """Place of a share of the x axis."""
        return self.left + (self.width - self.left - self.right) * share

    def y(self, value: float, y_range: tuple[float, float]) -> float:
        """Place of a value on the y axis."""
        height = self.height - self.top - self.bottom
        return self.top + height * (1 - (value - y_range[0]) / (y_range[1] - y_range[0]))


FULL = Box(560, 340, 52, 108, 30, 40, True)
SMALL = Box(320, 210, 44, 12, 26, 38, False)
"""For small multiples: names of lines stand in a legend of the page."""


@dataclass(frozen=True)
class Line:
    """One curve: name, colour class (``c0`` ...), x, y, and the band's ends (NaN where there is none)."""

    name: str
    colour: str
    x: Floats
    y: Floats
    low: Floats
    high: Floats
    singles: Floats


@dataclass(frozen=True)
class Level:
    """A horizontal reference line."""

    name: str
    value: float


@dataclass(frozen=True)
class Whisker:
    """A value with its interval (NaN ends where there is none)."""

    name: str
    colour: str
    value: float
    low: float
    high: float


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round values that cover a range.

    Example:
        >>> ticks(0.0, 1.0)
        [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """
    if not high > low:
        return [low]
    rough = (high - low) / count
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(min((m * power for m in (1, 2, 5, 10)), key=lambda size: abs(size - rough)))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [round(index * step, 10) + 0.0 for index in range(first, last + 1)]


def spread(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Positions of labels near where they are wanted, at least ``gap`` apart and inside [low, high].

    Args:
        wanted: positions, in any order.
        gap: smallest distance.
        low: smallest position.
        high: largest position.

    Returns:
        Positions in the order of ``wanted``.

    Example:
        >>> spread([10.0, 11.0], 4.0, 0.0, 100.0)
        [8.5, 12.5]
    """
    order = sorted(range(len(wanted)), key=lambda index: wanted[index])
    clusters: list[tuple[float, list[int]]] = []  # centre of a run of touching labels, and its members
    for index in order:
        clusters.append((wanted[index], [index]))
        while len(clusters) > 1 and _overlap(clusters[-2], clusters[-1], gap):
            (a, first), (b, second) = clusters[-2], clusters[-1]
            both = first + second
            clusters[-2:] = [((a * len(first) + b * len(second)) / len(both), both)]
    placed = [0.0] * len(wanted)
    for centre, members in clusters:
        half = gap * (len(members) - 1) / 2
        centre = min(max(centre, low + half), max(high - half, low + half))
        for place, index in enumerate(members):
            placed[index] = centre - half + gap * place
    return placed


def _overlap(above: tuple[float, list[int]], below: tuple[float, list[int]], gap: float) -> bool:
    half = gap * (len(above[1]) + len(below[1])) / 2
    return below[0] - above[0] < half


def line_chart(
    title: str, lines: Sequence[Line], levels: Sequence[Level], y_range: tuple[float, float], box: Box = FULL
) -> str:
    """Curves with bands, thin lines for single seeds, and dashed reference lines with their names at the right.

    Args:
        title: above the chart.
        lines: curves; the x axis is frames.
        levels: reference lines.
        y_range: of the y axis, shared by charts side by side.
        box: size; a small chart has neither names nor single seeds.

    Returns:
        An ``<svg>`` element.
    """
    x_high = max((float(line.x[-1]) for line in lines), default=1.0)
    parts = [_open(box.width, box.height, title), _text(box.left, 16, title, "title"), *_y_axis(box, y_range)]
    unit, name = (1e6, "million frames") if x_high >= 2e6 else (1e3, "thousand frames")
    for value in ticks(0.0, x_high / unit, 5 if box.named else 3):
        parts.append(_x_tick(box, value * unit / x_high, f"{value:g}"))
    parts += [_x_name(box, name), *_levels(box, levels, y_range)]
    parts += _lines(box, lines, lambda x: box.x(x / x_high), y_range, singles=box.named)
    return "".join([*parts, *(_labels(box, lines, levels, y_range) if box.named else []), "</svg>"])


def category_chart(
    title: str,
    lines: Sequence[Line],
    names: Sequence[str],
    axis: str,
    y_range: tuple[float, float],
    level: float | None = None,
    box: Box = SMALL,
) -> str:
    """Values at named places, joined by lines.

    Args:
        title: above the chart.
        lines: x counts the names from 0; where y is NaN there is no point.
        names: of the places; an empty name leaves its place unlabelled.
        axis: what the names are.
        y_range: of the y axis.
        level: value of a dashed reference line.
        box: size.

    Returns:
        An ``<svg>`` element.
    """

    def px(x: float) -> float:
        return box.x((x + 0.5) / len(names))

    parts = [_open(box.width, box.height, title), _text(box.left, 16, title, "title"), *_y_axis(box, y_range)]
    parts += [_x_tick(box, (place + 0.5) / len(names), name) for place, name in enumerate(names) if name]
    parts += [_x_name(box, axis), *_levels(box, [] if level is None else [Level("", level)], y_range)]
    return "".join([*parts, *_lines(box, lines, px, y_range, singles=False), "</svg>"])


def _lines(
    box: Box, lines: Sequence[Line], px: Callable[[float], float], y_range: tuple[float, float], singles: bool
) -> list[str]:
    """Bands below, then single seeds, then means; points where there are few."""

    def places(x: Floats, y: Floats) -> list[tuple[float, float]]:
        return [(px(a), box.y(b, y_range)) for a, b in zip(x, y, strict=True) if np.isfinite(b)]

    parts = []
    for line in lines:
        if np.isfinite(line.low).any():
            band = places(line.x, line.high) + places(line.x, line.low)[::-1]
            parts.append(_path(band, f"band {line.colour}", close=True))
        for single in line.singles if singles and len(line.singles) > 1 else []:
            parts.append(_path(places(line.x, single), f"single {line.colour}"))
    for line in lines:
        points = places(line.x, line.y)
        parts.append(_path(points, f"line {line.colour}"))
        if len(points) <= 12:
            size = 3 if box.named else 2.4
            parts += [f'<circle class="dot {line.colour}" cx="{x:.1f}" cy="{y:.1f}" r="{size}"/>' for x, y in points]
    return parts


def _levels(box: Box, levels: Sequence[Level], y_range: tuple[float, float]) -> list[str]:
    heights = [box.y(level.value, y_range) for level in levels]
    return [_path([(box.left, height), (box.width - box.right, height)], "level") for height in heights]


def _y_axis(box: Box, y_range: tuple[float, float]) -> list[str]:
    parts = []
    for value in ticks(*y_range, 5 if box.named else 3):
        height = box.y(value, y_range)
        parts.append(_path([(box.left, height), (box.width - box.right, height)], "grid"))
        parts.append(_text(box.left - 8, height + 4, f"{value:g}", "tick", "end"))
    return parts


def _x_tick(box: Box, share: float, text: str) -> str:
    return _text(box.x(share), box.height - box.bottom + 17, text, "tick", "middle")


def _x_name(box: Box, text: str) -> str:
    return _text(box.x(0.5), box.height - 5, text, "tick", "middle")


def _labels(box: Box, lines: Sequence[Line], levels: Sequence[Level], y_range: tuple[float, float]) -> list[str]:
    entries = [(float(line.y[-1]), line.name, f"label {line.colour}") for line in lines]
    entries += [(level.value, level.name, "label level") for level in levels]
    wanted = [box.y(value, y_range) for value, _, _ in entries]
    places = spread(wanted, 14.0, box.top, box.height - box.bottom)
    return [
        _text(box.width - box.right + 8, place + 4, name, style)
        for place, (_, name, style) in zip(places, entries, strict=True)
    ]


def whisker_chart(title: str, rows: Sequence[Whisker], x_range: tuple[float, float], zero: bool) -> str:
    """Values with intervals, one row each, with the number written beside.

    Args:
        title: above the chart.
        rows: top to bottom.
        x_range: of the x axis.
        zero: whether to mark zero by a line.

    Returns:
        An ``<svg>`` element.
    """
    width, left, right, row_height = 360, 76, 60, 34
    height = TOP + row_height * len(rows) + 28

    def px(x: float) -> float:
        return left + (width - left - right) * (x - x_range[0]) / (x_range[1] - x_range[0])

    parts = [_open(width, height, title), _text(left, 16, title, "title")]
    bottom = height - 26
    for value in ticks(*x_range, count=3):
        parts.append(_path([(px(value), TOP), (px(value), bottom)], "grid"))
        parts.append(_text(px(value), height - 8, f"{value:g}", "tick", "middle"))
    if zero:
        parts.append(_path([(px(0.0), TOP), (px(0.0), bottom)], "level"))
    for index, row in enumerate(rows):
        y = TOP + row_height * (index + 0.5)
        parts.append(_text(left - 10, y + 4, row.name, f"label {row.colour}", "end"))
        if np.isfinite(row.low):
            parts.append(_path([(px(row.low), y), (px(row.high), y)], f"whisker {row.colour}"))
        parts.append(f'<circle class="dot {row.colour}" cx="{px(row.value):.1f}" cy="{y:.1f}" r="5"/>')
        parts.append(_text(width - right + 8, y + 4, f"{row.value:+.2f}" if zero else f"{row.value:.2f}", "tick"))
    return "".join([*parts, "</svg>"])


def _open(width: int, height: int, title: str) -> str:
    return f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)}">'


def _text(x: float, y: float, text: str, style: str, anchor: str = "start") -> str:
    return f'<text class="{style}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _path(points: Sequence[tuple[float, float]], style: str, close: bool = False) -> str:
    steps = " ".join(f"{'ML'[index > 0]}{x:.1f} {y:.1f}" for index, (x, y) in enumerate(points))
    return f'<path class="{style}" d="{steps}{" Z" if close else ""}"/>'
