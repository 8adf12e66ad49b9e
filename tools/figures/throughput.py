"""Frames per second by number of environments, from the file that ``arcade-torch bench envs --out`` wrote."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.figures.registry import Made, Options, Progress
from arcade_torch.tools.figures.style import MARKERS, NEUTRAL, SPARE_COLOURS, drawing, footnote, inches, save
from arcade_torch.tools.files import read_csv

NEEDED = ("game", "obs_size", "num_envs", "measure", "frames", "frames_per_s", "frames_per_s_with_check")
OURS = {"step+draw": "compiled step", "env": "ArcadeEnv", "collector": "ArcadeCollector"}
LIMIT = "fill"


@dataclass(frozen=True)
class Series:
    """One line: its name, numbers of envs int64 [P], frames consumed per second float64 [P]."""

    name: str
    envs: Any
    rates: Any


def make(options: Options, progress: Progress | None) -> Made:
    """The figure ``throughput``: our games with and without drawing, and their mean by layer.

    ``options.runs`` is the one file; rates have the checksum over every frame inside the clock.
    """
    file = _one_file(options.runs)
    rows = read_rows(file)
    sizes = sorted({int(row["obs_size"]) for row in rows})
    here = [row for row in rows if int(row["obs_size"]) == sizes[0]]
    notes = [f"left out: frames of {', '.join(map(str, sizes[1:]))} px; drawn are {sizes[0]} px"] * (len(sizes) > 1)
    games = list(dict.fromkeys(str(row["game"]) for row in here))
    drawn = {game: series(here, game, "step+draw") for game in games}
    plain = {game: series(here, game, "step") for game in games}
    means = [mean_series(here, games, measure, name) for measure, name in OURS.items()]
    limit = mean_series(here, games, LIMIT, "writing the same bytes")
    with drawing(options.style) as plt:
        figure, (left, right) = plt.subplots(
            1, 2, figsize=inches(options.style, 11.5, 5.4), sharey=True, layout="constrained"
        )
        for place, game in enumerate(games):
            colour = SPARE_COLOURS[place % len(SPARE_COLOURS)]
            marker = MARKERS[(place + place // len(SPARE_COLOURS)) % len(MARKERS)]
            _line(left, drawn[game], colour, marker, "-", game)
            _line(left, plain[game], colour, marker, ":", None)
        left.plot([], [], color=NEUTRAL, ls=":", label="the same without drawing")
        for mean, marker in zip(means, ("*", "v", "o"), strict=True):
            _line(right, mean, "#0072b2", marker, "-", f"{mean.name}, mean of {len(games)}")
        _line(right, limit, NEUTRAL, "", "--", limit.name)
        _axes(left, here, "this package's games")
        _axes(right, here, "their mean, by layer")
        left.set_ylabel("frames/s")
        first = here[0]
        footnote(
            figure,
            f"{sizes[0]} px, every frame consumed by a checksum inside the clock; median of repeats, no interval; "
            f"{first.get('jax_device', 'unknown device')}, {first.get('cores', '?')} cores, "
            f"arcade-torch {first.get('arcade-torch', '?')} ({first.get('commit') or 'no commit'})",
        )
        numbers = _rows(drawn, plain, [*means, limit])
        return Made(save(options, "throughput", figure, numbers), notes, rows=numbers)


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a benchmark's file."""
    rows = read_csv(path)
    missing = [name for name in NEEDED if not rows or name not in rows[0]]
    if missing:
        raise ValueError(
            f"{path} has no column {missing[0]}: give the file that `arcade-torch bench envs --out FILE.csv` wrote"
        )
    for row in rows:
        for name, kind in (("obs_size", int), ("num_envs", int), ("frames_per_s_with_check", float)):
            try:
                if not 0 < kind(row[name]) < 10**12:
                    raise ValueError
            except ValueError:
                raise ValueError(f"{path}: {name} is {row[name]!r}, expected a number above 0") from None
    if not any(row["measure"] == "step+draw" for row in rows):
        raise ValueError(f"{path} has no row with the measure step+draw: nothing to draw")
    return rows


def series(rows: Sequence[dict[str, str]], game: str, measure: str) -> Series:
    """Rates of one game by number of envs."""
    found = {
        int(row["num_envs"]): float(row["frames_per_s_with_check"])
        for row in rows
        if (row["game"], row["measure"]) == (game, measure)
    }
    envs = np.array(sorted(found), dtype=np.int64)
    return Series(game, envs, np.array([found[count] for count in sorted(found)]))


def mean_series(rows: Sequence[dict[str, str]], games: Sequence[str], measure: str, name: str) -> Series:
    """Mean rate over games, at the numbers of envs that all of them were measured with."""
    every = [series(rows, game, measure) for game in games]
    shared = sorted(set.intersection(*(set(one.envs.tolist()) for one in every)))
    rates = [[one.rates[one.envs.tolist().index(count)] for one in every] for count in shared]
    return Series(name, np.array(shared, dtype=np.int64), np.array([np.mean(row) for row in rates]))


def _one_file(paths: Sequence[Path]) -> Path:
    if len(paths) != 1:
        raise ValueError(
            f"throughput is drawn from one file of `arcade-torch bench envs --out FILE.csv`, got {len(paths)}: "
            "give --runs FILE.csv"
        )
    if paths[0].is_dir():
        raise ValueError(f"{paths[0]} is a folder: give the CSV file that `arcade-torch bench envs --out` wrote")
    return paths[0]


def _line(axis: Any, one: Series, colour: str, marker: str, style: str, label: str | None) -> None:
    if one.envs.size:
        size = 11 if marker == "*" else None
        axis.plot(one.envs, one.rates, color=colour, marker=marker, ms=size, ls=style, label=label)


def _axes(axis: Any, rows: Sequence[dict[str, str]], title: str) -> None:
    counts = sorted({int(row["num_envs"]) for row in rows})
    axis.set_xscale("log", base=2)
    axis.set_yscale("log", base=10)
    axis.set_xticks(counts, [str(count) for count in counts])
    axis.minorticks_off()
    axis.set_xlabel("environments")
    axis.set_title(title)
    axis.legend(
        fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2 if len(axis.lines) < 9 else 3
    )


def _rows(drawn: dict[str, Series], plain: dict[str, Series], rest: Sequence[Series]) -> list[dict[str, Any]]:
    named = [("drawing", one) for one in drawn.values()] + [("no drawing", one) for one in plain.values()]
    named += [("mean or other", one) for one in rest]
    return [
        {"series": one.name, "kind": kind, "num_envs": int(count), "frames_per_s": rate}
        for kind, one in named
        for count, rate in zip(one.envs, one.rates, strict=True)
    ]
