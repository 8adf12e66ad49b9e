"""What runs and benchmarks have written down: training curves, frames per second, and settings."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np

from arcade_torch.agents import preset
from arcade_torch.agents.config import TrainConfig, flatten, require
from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.analysis.bootstrap import Array, Pooled, pooled
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures import (
    CurveOptions,
    Made,
    Options,
    PaperOptions,
    Picture,
    Progress,
    style,
)
from arcade_torch.tools.files import markdown_table, read_csv, read_rows
from arcade_torch.tools.names import plain_number
from arcade_torch.tools.runs import Run
from arcade_torch.tools.text import printable

POINTS = 120  # of a curve of training returns
AXIS = {"eval": "greedy return", "train": "training return, running mean"}

OURS = {"compiled step": "step+draw", "ArcadeEnv": "env", "ArcadeCollector": "collector"}
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
LIMIT = "writing the same bytes"

NOT_SETTINGS = (
    "env",
    "observability",
    "memory",
    "seed",
    "algorithm",
    "device",
    "threads",
    "checkpoint_every",
)
"""Fields that tell runs apart, or decide nothing."""
ALGORITHMS = get_args(get_type_hints(TrainConfig)["algorithm"])


class Curve(NamedTuple):
    """One agent on one task: returns at some frames."""

    frames: Array
    returns: Pooled


def curves(options: CurveOptions, progress: Progress | None) -> Made:
    """The figure ``curves``: a panel a task, a line an agent, mean over seeds with a band."""
    found = find_runs(options.runs)
    kind = "eval" if options.metric == "eval_final" else "train"
    every = curves_of_runs(found.groups(), kind, options.confidence)
    if not every:
        raise ValueError(
            f"no run below {options.runs[0]} has logged a {AXIS[kind]}: nothing to draw"
        )
    tasks = style.agents_by_task(every)
    agents = list(dict.fromkeys(agent for agent, _, _ in every))
    columns = min(4, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    figure, axes = style.panels(lines, columns, (max(5.5, 3.9 * columns), 0.8 + 3.0 * lines))
    for axis in axes.flat[len(tasks) :]:
        axis.set_axis_off()
    of_game: dict[str, Any] = {}
    for axis, ((game, twin), here) in zip(axes.flat, tasks.items(), strict=False):
        axis.sharey(of_game.setdefault(game, axis))  # twins are there to be compared
        plot(here, axis, agents)
        axis.set(title=f"{game}, {style.TWIN_NAMES.get(twin, twin)}", ylabel=AXIS[kind])
    handles = {handle.get_label(): handle for axis in axes.flat for handle in axis.get_lines()}
    shown = [handles[label] for label in map(style.legend_name, agents) if label in handles]
    figure.legend(handles=shown, loc="outside upper center", ncols=min(8, len(shown)))
    rows = []
    for (agent, game, twin), (frames, (seeds, mean, low, high)) in every.items():
        what = {"agent": agent, "game": game, "observability": twin, "seeds": len(seeds)}
        rows += style.rows_of(**what, frames=frames.astype(np.int64), mean=mean, low=low, high=high)
    note = style.seeds_note(
        [len(curve.returns.seeds) for curve in every.values()], options.confidence, "bands"
    )
    return Made([Picture("curves", figure, note, rows)], found.notes + found.single_seeds())


def plot(
    curves: Mapping[str, Curve],
    axis: Any,
    agents: Sequence[str],
    levels: Mapping[str, float] | None = None,
) -> None:
    """Draw the curves of one task; ``levels`` are dashed lines with a name."""
    longest = max(float(curve.frames[-1]) for curve in curves.values())
    unit, name = (1e6, "million frames") if longest >= 2e6 else (1e3, "thousand frames")
    for agent, (frames, returns) in curves.items():
        place = agents.index(agent)
        colour = style.agent_colours(agents)[agent]
        x = frames / unit
        if np.isfinite(returns.low).any():
            axis.fill_between(x, returns.low, returns.high, color=colour, alpha=0.18, lw=0)
        marker = style.MARKERS[place % len(style.MARKERS)] if x.size <= 12 else None
        line = style.DASHES[place % len(style.DASHES)]
        axis.plot(
            x, returns.mean, color=colour, label=style.legend_name(agent), marker=marker, ls=line
        )
    for level, value in (levels or {}).items():
        axis.axhline(value, color=style.NEUTRAL, lw=1, ls="--")
        axis.annotate(
            level,
            (1, value),
            (-2, 2),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            ha="right",
            color=style.NEUTRAL,
            fontsize="small",
        )
    axis.set_xlabel(name)


def curves_of_runs(
    groups: Mapping[tuple[str, str, str], Sequence[Run]],
    kind: str = "eval",
    confidence: float = 0.95,
) -> dict[tuple[str, str, str], Curve]:
    """A curve for each group, (agent, game, observability) -> its runs, that has logged something.

    It goes over the frames that all runs of the group have reached. ``kind`` is ``eval`` (greedy
    evaluations) or ``train`` (running mean of training returns, exploration included).
    """
    found = {}
    for task, runs in groups.items():
        histories = [history for run in runs if (history := _history(run, kind))[0].size]
        if not histories:
            continue
        end = min(frames[-1] for frames, _ in histories)
        start = max(frames[0] for frames, _ in histories)
        longest = max((frames for frames, _ in histories), key=len)
        grid = (
            longest[(longest >= start) & (longest <= end)]
            if kind == "eval"
            else np.linspace(start, end, POINTS)
        )
        if grid.size:
            seeds = [np.interp(grid, frames, values) for frames, values in histories]
            found[task] = Curve(grid, pooled(seeds, confidence))
    return found


def _history(run: Run, kind: str) -> tuple[Array, Array]:
    name, column = ("eval.csv", "mean") if kind == "eval" else ("metrics.csv", "train_return_ewm")
    rows = [row for row in run.table(name) if row.get(column)]
    try:
        frames = np.array([float(row["frames"]) for row in rows])
        return frames, np.array([float(row[column]) for row in rows])
    except ValueError as error:
        raise ValueError(f"{run.path / name} is damaged: {error}") from None


class Rate(NamedTuple):
    """What is read of a row of ``bench envs``."""

    game: str
    measure: str
    obs_size: int
    num_envs: int
    frames_per_s_with_check: float


def throughput(options: Options, progress: Progress | None) -> Made:
    """The figure ``throughput``: our games with and without drawing, and their mean by layer.

    ``options.runs`` is the one file of ``bench envs``; rates have the checksum over every frame
    inside the clock.
    """
    wanted = "one file of `arcade-torch bench envs --out FILE.csv`"
    given = list(map(str, options.runs))
    require(len(given) == 1, "--runs", given, wanted)
    rows = read_rows(options.runs[0], Rate)
    if not all(0 < number < 10**12 for row in rows for number in row[2:]):
        raise ValueError(f"{options.runs[0]}: obs_size, num_envs and rates must be numbers above 0")
    if not any(row.measure == "step+draw" for row in rows):
        raise ValueError(
            f"{options.runs[0]} has no row with the measure step+draw: nothing to draw"
        )
    rows = [row._replace(game=printable(row.game)) for row in rows]
    sizes = sorted({row.obs_size for row in rows})
    here = [row for row in rows if row.obs_size == sizes[0]]
    notes = [
        f"left out: frames of {', '.join(map(str, sizes[1:]))} px; drawn are {sizes[0]} px"
    ] * (len(sizes) > 1)
    games = list(dict.fromkeys(row.game for row in here))
    counts = sorted({row.num_envs for row in here})
    drawn, bare = (
        {game: series(here, game, kind) for game in games} for kind in ("step+draw", "step")
    )
    rest = {name: mean_series(here, games, kind) for name, kind in (OURS | {LIMIT: "fill"}).items()}
    figure, ((left, right),) = style.panels(1, 2, (11.5, 5.4), sharey=True)
    for place, game in enumerate(games):
        spare = len(style.SPARE_COLOURS)
        marker = style.MARKERS[(place + place // spare) % len(style.MARKERS)]
        look = {"color": style.SPARE_COLOURS[place % spare], "marker": marker}
        _line(left, drawn[game], label=style.legend_name(game), **look)
        _line(left, bare[game], ls=":", **look)
    left.plot([], [], color=style.NEUTRAL, ls=":", label="the same without drawing")
    for name, marker, size in zip(OURS, "*vo", (11, None, None), strict=True):
        _line(
            right,
            rest[name],
            label=f"{name}, mean of {len(games)}",
            color="#0072b2",
            marker=marker,
            ms=size,
        )
    _line(right, rest[LIMIT], label=LIMIT, color=style.NEUTRAL, ls="--")
    for axis, title in ((left, "this package's games"), (right, "their mean, by layer")):
        axis.set_xscale("log", base=2)
        axis.set_yscale("log", base=10)
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.yaxis.set_major_formatter(lambda rate, place: power_of_ten(rate))
        axis.minorticks_off()
        axis.set(xlabel="environments", title=title)
        columns = 2 if len(axis.lines) < 9 else 3
        axis.legend(
            fontsize="small", ncols=columns, loc="upper center", bbox_to_anchor=(0.5, -0.16)
        )
    left.set_ylabel("frames/s")
    made = read_csv(options.runs[0])[0]
    numbers = list[dict[str, Any]]()
    note = (
        f"{sizes[0]} px, every frame consumed by a checksum inside the clock; median of repeats, "
        "no interval; "
        f"{made.get('jax_device', 'unknown device')}, {made.get('cores', '?')} cores, "
        f"arcade-torch {made.get('arcade_torch', '?')} ({made.get('commit') or 'no commit'})"
    )
    for kind, lines in {"drawing": drawn, "no drawing": bare, "mean": rest}.items():
        for name, line in lines.items():
            numbers += style.rows_of(
                series=name, kind=kind, num_envs=list(line), frames_per_s=list(line.values())
            )
    return Made([Picture("throughput", figure, note, numbers)], notes)


def power_of_ten(value: float) -> str:
    """A tick of an axis whose ticks are powers of ten.

    Example:
        >>> power_of_ten(1e6)
        '10⁶'
    """
    return "10" + str(round(math.log10(value))).translate(SUPERSCRIPT) if value > 0 else ""


def series(rows: Sequence[Rate], game: str, measure: str) -> dict[int, float]:
    """Number of envs -> frames consumed per second, of one game."""
    here = [row for row in rows if (row.game, row.measure) == (game, measure)]
    return dict(sorted((row.num_envs, row.frames_per_s_with_check) for row in here))


def mean_series(rows: Sequence[Rate], games: Sequence[str], measure: str) -> dict[int, float]:
    """Mean rate over games, at the numbers of envs that all of them were measured with."""
    every = [series(rows, game, measure) for game in games]
    shared = sorted(set.intersection(*map(set, every))) if every else []
    return {count: float(np.mean([one[count] for one in every])) for count in shared}


def _line(axis: Any, rates: Mapping[int, float], **look: Any) -> None:
    if rates:
        axis.plot(list(rates), list(rates.values()), **look)


def hyperparameters(options: PaperOptions, progress: Progress | None) -> Made:
    """``hyperparameters``: CSV and Markdown, and the table as a picture; one column an algorithm.

    Generated from the configs themselves, so that it cannot go stale.
    """
    configs: dict[str, list[Mapping[str, Any]]] = {}
    if options.paper:
        notes = [
            f"total_frames is that of {TrainConfig().env}; the paper's budget depends on the game"
        ]
        configs = {name: [preset("paper", algorithm=name).to_dict()] for name in ALGORITHMS}
    else:
        found = find_runs(options.runs)
        notes = list(found.notes)
        for run in found.runs:
            configs.setdefault(str(run.config.get("algorithm", "pqn")), []).append(run.config)
    columns = {name: _settings(here, name) for name, here in configs.items()}
    names = dict.fromkeys(name for column in columns.values() for name in column)
    rows = [
        {"setting": name} | {key: column.get(name, "") for key, column in columns.items()}
        for name in names
    ]
    if not rows:
        raise ValueError(
            f"the runs below {options.runs[0]} say nothing of their settings: nothing to draw"
        )
    head = ["setting", *columns]
    table = [list(row.values()) for row in rows]
    figure, axes = style.panels(1, 1, (2.8 + 2.6 * len(columns), 0.26 * (len(rows) + 2)))
    axes[0, 0].set_axis_off()
    drawn = axes[0, 0].table(
        table, colLabels=head, bbox=(0, 0, 1, 1), cellLoc="left", edges="horizontal"
    )
    drawn.auto_set_font_size(False)
    for (line, _), cell in drawn.get_celld().items():
        cell.set_edgecolor("#d0d0d0")
        cell.set_text_props(weight="normal" if line else "bold")
    base, endings = options.path("hyperparameters")
    page = base.with_suffix(".md")
    several = len(endings) > 1
    files = [write_atomic(page, markdown_table(head, table) + "\n")] if several else []
    return Made([Picture("hyperparameters", figure, rows=rows)], notes, files=files)


def _settings(configs: Sequence[Mapping[str, Any]], algorithm: str) -> dict[str, str]:
    """Each setting's value, or all its values where runs differ; without the settings of other
    algorithms.
    """
    others = {*NOT_SETTINGS, *ALGORITHMS} - {algorithm}

    def stated_by(config: Mapping[str, Any]) -> dict[str, str]:
        flat = flatten({key: value for key, value in config.items() if key not in others})
        return {
            name.removeprefix(f"{algorithm}."): _text(value)
            for name, value in flat.items()
            if value != {}
        }

    default = stated_by(TrainConfig().to_dict())  # of a setting that a run does not state
    stated = [stated_by(config) for config in configs]
    values = dict[str, str]()
    for name in dict.fromkeys(name for settings in stated for name in settings):
        several = {settings.get(name, default.get(name, "-")) for settings in stated}
        values[name] = " / ".join(sorted(several))
    return values


def _text(value: Any) -> str:
    """A setting in one form: 0 and 0.0 are the same number."""
    return str(plain_number(value))
