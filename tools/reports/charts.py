"""Charts as inline SVG that take their colours from the page, so that they follow its light and dark form."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WIDTH, HEIGHT = 560, 340
LEFT, RIGHT, TOP, BOTTOM = 52, 108, 30, 40


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


def line_chart(title: str, lines: Sequence[Line], levels: Sequence[Level], y_range: tuple[float, float]) -> str:
    """Curves with bands, thin lines for single seeds, and dashed reference lines with their names at the right.

    Args:
        title: above the chart.
        lines: curves; the x axis is frames.
        levels: reference lines.
        y_range: of the y axis, shared by charts side by side.

    Returns:
        An ``<svg>`` element.
    """
    x_high = max((float(line.x[-1]) for line in lines), default=1.0)

    def px(x: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * x / x_high

    def py(y: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - (y - y_range[0]) / (y_range[1] - y_range[0]))

    parts = [_open(WIDTH, HEIGHT, title), _text(LEFT, 16, title, "title")]
    parts += _axes(px, py, x_high, y_range)
    for level in levels:
        parts.append(_path([(LEFT, py(level.value)), (WIDTH - RIGHT, py(level.value))], "level"))
    for line in lines:
        if np.isfinite(line.low).any():
            band = [(px(x), py(y)) for x, y in zip(line.x, line.high, strict=True)]
            band += [(px(x), py(y)) for x, y in zip(line.x[::-1], line.low[::-1], strict=True)]
            parts.append(_path(band, f"band {line.colour}", close=True))
        for single in line.singles if len(line.singles) > 1 else []:
            parts.append(_path([(px(x), py(y)) for x, y in zip(line.x, single, strict=True)], f"single {line.colour}"))
    for line in lines:
        points = [(px(x), py(y)) for x, y in zip(line.x, line.y, strict=True)]
        parts.append(_path(points, f"line {line.colour}"))
        if len(points) <= 12:
            parts += [f'<circle class="dot {line.colour}" cx="{x:.1f}" cy="{y:.1f}" r="3"/>' for x, y in points]
    parts += _labels(lines, levels, py)
    return "".join([*parts, "</svg>"])


def _axes(px: object, py: object, x_high: float, y_range: tuple[float, float]) -> list[str]:
    assert callable(px) and callable(py)
    parts = []
    for value in ticks(*y_range):
        parts.append(_path([(LEFT, py(value)), (WIDTH - RIGHT, py(value))], "grid"))
        parts.append(_text(LEFT - 8, py(value) + 4, f"{value:g}", "tick", "end"))
    unit, name = (1e6, "million frames") if x_high >= 2e6 else (1e3, "thousand frames")
    for value in ticks(0.0, x_high / unit):
        parts.append(_text(px(value * unit), HEIGHT - BOTTOM + 18, f"{value:g}", "tick", "middle"))
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 5, name, "tick", "middle"))
    return parts


def _labels(lines: Sequence[Line], levels: Sequence[Level], py: object) -> list[str]:
    assert callable(py)
    entries = [(float(line.y[-1]), line.name, f"label {line.colour}") for line in lines]
    entries += [(level.value, level.name, "label level") for level in levels]
    places = spread([py(value) for value, _, _ in entries], 14.0, TOP, HEIGHT - BOTTOM)
    return [
        _text(WIDTH - RIGHT + 8, place + 4, name, style)
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
