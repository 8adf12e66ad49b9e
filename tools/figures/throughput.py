"""Frames per second by number of environments, from the file that ``arcade-torch bench envs --out`` wrote."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.figures.registry import Made, Options, Picture, Progress
from arcade_torch.tools.figures.style import MARKERS, NEUTRAL, SPARE_COLOURS, panels, rows_of
from arcade_torch.tools.files import read_csv

NEEDED = ("game", "obs_size", "num_envs", "measure", "frames", "frames_per_s", "frames_per_s_with_check")
OURS = {"compiled step": "step+draw", "ArcadeEnv": "env", "ArcadeCollector": "collector"}
LIMIT = "writing the same bytes"

Series = Mapping[int, float]
"""One line: number of envs -> frames consumed per second."""


def rates(options: Options, progress: Progress | None) -> Made:
    """The figure ``throughput``: our games with and without drawing, and their mean by layer.

    ``options.runs`` is the one file; rates have the checksum over every frame inside the clock.
    """
    rows = read_rows(_one_file(options.runs))
    sizes = sorted({int(row["obs_size"]) for row in rows})
    here = [row for row in rows if int(row["obs_size"]) == sizes[0]]
    notes = [f"left out: frames of {', '.join(map(str, sizes[1:]))} px; drawn are {sizes[0]} px"] * (len(sizes) > 1)
    games = list(dict.fromkeys(str(row["game"]) for row in here))
    drawn, plain = ({game: series(here, game, kind) for game in games} for kind in ("step+draw", "step"))
    rest = {name: mean_series(here, games, measure) for name, measure in OURS.items()}
    rest |= {LIMIT: mean_series(here, games, "fill")}
    figure, axes = panels(1, 2, (11.5, 5.4), sharey=True)
    left, right = axes[0]
    for place, game in enumerate(games):
        colour = SPARE_COLOURS[place % len(SPARE_COLOURS)]
        marker = MARKERS[(place + place // len(SPARE_COLOURS)) % len(MARKERS)]
        _line(left, drawn[game], colour, marker, "-", game)
        _line(left, plain[game], colour, marker, ":", None)
    left.plot([], [], color=NEUTRAL, ls=":", label="the same without drawing")
    for name, marker in zip(OURS, ("*", "v", "o"), strict=True):
        _line(right, rest[name], "#0072b2", marker, "-", f"{name}, mean of {len(games)}")
    _line(right, rest[LIMIT], NEUTRAL, "", "--", LIMIT)
    counts = sorted({int(row["num_envs"]) for row in here})
    for axis, title in ((left, "this package's games"), (right, "their mean, by layer")):
        axis.set_xscale("log", base=2)
        axis.set_yscale("log", base=10)
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.minorticks_off()
        axis.set(xlabel="environments", title=title)
        axis.legend(
            fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2 if len(axis.lines) < 9 else 3
        )
    left.set_ylabel("frames/s")
    first = here[0]
    note = (
        f"{sizes[0]} px, every frame consumed by a checksum inside the clock; median of repeats, no interval; "
        f"{first.get('jax_device', 'unknown device')}, {first.get('cores', '?')} cores, "
        f"arcade-torch {first.get('arcade-torch', '?')} ({first.get('commit') or 'no commit'})"
    )
    numbers = list[dict[str, Any]]()
    for kind, lines in {"drawing": drawn, "no drawing": plain, "mean": rest}.items():
        for name, line in lines.items():
            numbers += rows_of(series=name, kind=kind, num_envs=list(line), frames_per_s=list(line.values()))
    return Made([Picture("throughput", figure, note, numbers)], notes)


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


def series(rows: Sequence[Mapping[str, str]], game: str, measure: str) -> Series:
    """Rates of one game by number of envs."""
    here = [row for row in rows if (row["game"], row["measure"]) == (game, measure)]
    return dict(sorted((int(row["num_envs"]), float(row["frames_per_s_with_check"])) for row in here))


def mean_series(rows: Sequence[Mapping[str, str]], games: Sequence[str], measure: str) -> Series:
    """Mean rate over games, at the numbers of envs that all of them were measured with."""
    every = [series(rows, game, measure) for game in games]
    shared = sorted(set.intersection(*map(set, every)))
    return {count: float(np.mean([one[count] for one in every])) for count in shared}


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
    if one:
        size = 11 if marker == "*" else None
        axis.plot(list(one), list(one.values()), color=colour, marker=marker, ms=size, ls=style, label=label)
