"""What runs and benchmarks have written down: training curves, frames per second, and settings."""

import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np

from arcade_torch.agents import preset
from arcade_torch.agents.checked import require
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.differences import flatten
from arcade_torch.agents.runs.files import read_csv, write_atomic
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures import (
    CurveOptions,
    Made,
    Options,
    Picture,
    Progress,
    TableOptions,
    style,
)
from arcade_torch.tools.files import markdown_table, read_rows
from arcade_torch.tools.measures.bootstrap import Array, Pooled, pooled
from arcade_torch.tools.names import plain_number
from arcade_torch.tools.runs import Run
from arcade_torch.tools.text import printable

POINTS = 120  # of a curve of training returns
AXIS = {"eval": "greedy return", "train": "training return, running mean"}

OURS = {"compiled step": "step+draw", "ArcadeEnv": "env", "ArcadeCollector": "collector"}
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
LIMIT = "writing the same bytes"

NOT_SETTINGS = (
    "env", "observability", "memory", "seed", "algorithm", "device", "threads", "checkpoint_every",
)  # fmt: skip
"""Fields that tell runs apart, or decide nothing."""
ALGORITHMS = get_args(get_type_hints(TrainConfig)["algorithm"])


class Curve(NamedTuple):
    """One agent on one task: returns at some frames."""

    frames: Array
    returns: Pooled


def curves(options: CurveOptions, progress: Progress | None) -> Made:
    """The figure ``curves``: a panel a task, a line an agent, mean over seeds with a band."""
    runs = find_runs(options.runs)
    kind = "eval" if options.metric == "eval_final" else "train"
    all_curves = curves_of_runs(runs.groups(), kind, options.confidence)
    if not all_curves:
        raise ValueError(
            f"no run below {options.runs[0]} has logged a {AXIS[kind]}: nothing to draw"
        )
    figure = _curve_figure(all_curves, AXIS[kind])
    rows = list[dict[str, Any]]()
    counts = list[int]()
    for (agent, game, twin), curve in all_curves.items():
        returns = curve.returns
        counts.append(len(returns.seeds))
        rows += style.rows_of(
            agent=agent,
            game=game,
            observability=twin,
            seeds=len(returns.seeds),
            frames=curve.frames.astype(np.int64),
            mean=returns.mean,
            low=returns.low,
            high=returns.high,
        )
    note = style.seeds_note(counts, options.confidence, "bands")
    return Made([Picture("curves", figure, note, rows)], runs.notes + runs.single_seeds())


def _curve_figure(curves: Mapping[tuple[str, str, str], Curve], ylabel: str) -> Any:
    """Draw a panel a task; the twins of a game share their y axis, and all panels one legend."""
    tasks = style.agents_by_task(curves)
    agents = list(dict.fromkeys(agent for agent, _, _ in curves))
    columns = min(4, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    figure, axes = style.panels(lines, columns, (max(5.5, 3.9 * columns), 0.8 + 3.0 * lines))
    for axis in axes.flat[len(tasks) :]:
        axis.set_axis_off()
    axis_of_game: dict[str, Any] = {}
    handles: dict[str, Any] = {}
    for axis, ((game, twin), by_agent) in zip(axes.flat, tasks.items(), strict=False):
        axis.sharey(axis_of_game.setdefault(game, axis))  # twins are there to be compared
        plot(by_agent, axis, agents)
        axis.set(title=f"{game}, {style.TWIN_NAMES.get(twin, twin)}", ylabel=ylabel)
        for handle in axis.get_lines():
            handles[handle.get_label()] = handle
    in_legend = []
    for agent in agents:
        label = style.legend_name(agent)
        if label in handles:
            in_legend.append(handles[label])
    style.legend_above(figure, in_legend)
    return figure


def plot(
    curves: Mapping[str, Curve],
    axis: Any,
    agents: Sequence[str],
    levels: Mapping[str, float] | None = None,
) -> None:
    """Draw the curves of one task; ``levels`` are dashed lines with a name."""
    longest = max(float(curve.frames[-1]) for curve in curves.values())
    unit, name = (1e6, "million frames") if longest >= 2e6 else (1e3, "thousand frames")
    colours = style.agent_colours(agents)
    markers = style.agent_markers(agents, colours)
    for agent, (frames, returns) in curves.items():
        place = agents.index(agent)
        x = frames / unit
        if np.isfinite(returns.low).any():
            axis.fill_between(x, returns.low, returns.high, color=colours[agent], alpha=0.18, lw=0)
        look = {"color": colours[agent], "marker": markers[agent] if x.size <= 12 else None}
        line = style.DASHES[(place + place // len(style.SPARE_COLOURS)) % len(style.DASHES)]
        axis.plot(x, returns.mean, label=style.legend_name(agent), ls=line, **look)
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

    It goes over the frames that all runs of the group have reached, without a mean where one has no
    finite number. ``kind`` is ``eval`` (greedy evaluations) or ``train`` (running mean of training
    returns, exploration included).
    """
    curves = {}
    for task, runs in groups.items():
        histories = _histories(runs, kind)
        grid = _shared_frames(histories, kind) if histories else np.empty(0)
        if not grid.size:
            continue
        seeds = [np.interp(grid, history.frames, history.values) for history in histories]
        # the mean of the other seeds would be that of another agent
        is_whole = np.isfinite(seeds).all(axis=0)
        whole = [np.where(is_whole, returns, np.nan) for returns in seeds]
        curves[task] = Curve(grid, pooled(whole, confidence))
    return curves


class History(NamedTuple):
    """What one run has logged: values at some frames."""

    frames: Array
    values: Array


def _histories(runs: Sequence[Run], kind: str) -> list[History]:
    """The histories of the runs that have logged something."""
    histories = [_history(run, kind) for run in runs]
    return [history for history in histories if history.frames.size]


def _shared_frames(histories: Sequence[History], kind: str) -> Array:
    """Where a mean over runs has values: within the frames that all of them have reached."""
    frames = [history.frames for history in histories]
    start = max(steps[0] for steps in frames)
    end = min(steps[-1] for steps in frames)
    if kind == "train":
        return np.linspace(start, end, POINTS)
    longest = max(frames, key=len)
    return np.compress((longest >= start) & (longest <= end), longest)


def _history(run: Run, kind: str) -> History:
    """Read the table of a run that has its returns; a ``ValueError`` if it is damaged."""
    name, column = ("eval.csv", "mean") if kind == "eval" else ("metrics.csv", "train_return_ewm")
    frames = list[float]()
    values = list[float]()
    rows = run.table(name)
    try:
        for row in rows:
            if row.get(column):
                frames.append(float(row["frames"]))
                values.append(float(row[column]))
    except ValueError as error:
        raise ValueError(f"{run.path / name} is damaged: {error}") from None
    return History(np.array(frames), np.array(values))


Line = dict[int, float]
"""Number of envs -> frames per second."""


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
    file = options.runs[0]
    rates = _read_rates(file)
    sizes = sorted({rate.obs_size for rate in rates})
    smallest = sizes[0]
    notes = []
    if len(sizes) > 1:
        others = ", ".join(map(str, sizes[1:]))
        notes.append(f"left out: frames of {others} px; drawn are {smallest} px")
    rates = [rate for rate in rates if rate.obs_size == smallest]
    counts = sorted({rate.num_envs for rate in rates})
    lines = _throughput_lines(rates)
    figure = _throughput_figure(lines, counts)
    numbers = list[dict[str, Any]]()
    for kind, by_name in lines._asdict().items():
        for name, line in by_name.items():
            numbers += style.rows_of(
                series=name,
                kind=KINDS_OF_LINES[kind],
                num_envs=list(line),
                frames_per_s=list(line.values()),
            )
    machine = read_csv(file)[0]  # the same in every row
    note = (
        f"{smallest} px, every frame consumed by a checksum inside the clock; median of repeats, "
        f"no interval; {machine.get('jax_device', 'unknown device')}, {machine.get('cores', '?')} "
        f"cores, arcade-torch {machine.get('arcade_torch', '?')} "
        f"({machine.get('commit') or 'no commit'})"
    )
    return Made([Picture("throughput", figure, note, numbers)], notes)


def _read_rates(file: Path) -> list[Rate]:
    """Read the rates of a file of ``bench envs``; a ``ValueError`` if they cannot be drawn."""
    rates = []
    for rate in read_rows(file, Rate):
        for number in (rate.obs_size, rate.num_envs, rate.frames_per_s_with_check):
            if not 0 < number < 10**12:
                raise ValueError(f"{file}: obs_size, num_envs and rates must be numbers above 0")
        rates.append(rate._replace(game=printable(rate.game)))
    if not any(rate.measure == "step+draw" for rate in rates):
        raise ValueError(f"{file} has no row with the measure step+draw: nothing to draw")
    return rates


class ThroughputLines(NamedTuple):
    """The lines of the figure ``throughput``."""

    drawn: dict[str, Line]  # game -> rate with drawing
    bare: dict[str, Line]  # game -> rate without
    means: dict[str, Line]  # layer, or `LIMIT` -> mean over games


KINDS_OF_LINES = {"drawn": "drawing", "bare": "no drawing", "means": "mean"}
"""How the CSV file names the lines."""


def _throughput_lines(rates: Sequence[Rate]) -> ThroughputLines:
    """The lines of rates that were all measured with frames of one size."""
    games = list(dict.fromkeys(rate.game for rate in rates))
    lines = ThroughputLines({}, {}, {})
    for game in games:
        lines.drawn[game] = series(rates, game, "step+draw")
        lines.bare[game] = series(rates, game, "step")
    for name, measure in (OURS | {LIMIT: "fill"}).items():
        lines.means[name] = mean_series(rates, games, measure)
    return lines


def _throughput_figure(lines: ThroughputLines, counts: Sequence[int]) -> Any:
    """Draw two panels on one scale, with ticks at the numbers of envs: single games, and means."""
    figure, axes = style.panels(1, 2, (11.5, 5.4), sharey=True)
    left, right = axes[0]
    spare = len(style.SPARE_COLOURS)
    for place, (game, drawn) in enumerate(lines.drawn.items()):
        marker = style.MARKERS[(place + place // spare) % len(style.MARKERS)]
        look = {"color": style.SPARE_COLOURS[place % spare], "marker": marker}
        _line(left, drawn, label=style.legend_name(game), **look)
        _line(left, lines.bare[game], ls=":", **look)
    left.plot([], [], color=style.NEUTRAL, ls=":", label="the same without drawing")
    for name, marker, size in zip(OURS, "*vo", (11, None, None), strict=True):
        label = f"{name}, mean of {len(lines.drawn)}"
        _line(right, lines.means[name], label=label, color="#0072b2", marker=marker, ms=size)
    _line(right, lines.means[LIMIT], label=LIMIT, color=style.NEUTRAL, ls="--")
    left.set_title("this package's games")
    right.set_title("their mean, by layer")
    left.set_ylabel("frames/s")
    for axis in (left, right):
        axis.set_xscale("log", base=2)
        axis.set_yscale("log", base=10)
        axis.set_xticks(counts, list(map(str, counts)))
        axis.yaxis.set_major_formatter(lambda rate, place: power_of_ten(rate))
        axis.minorticks_off()
        axis.set_xlabel("environments")
        columns = 2 if len(axis.lines) < 9 else 3
        axis.legend(
            fontsize="small", ncols=columns, loc="upper center", bbox_to_anchor=(0.5, -0.16)
        )
    return figure


def power_of_ten(value: float) -> str:
    """A tick of an axis whose ticks are powers of ten.

    Example:
        >>> power_of_ten(1e6)
        '10⁶'
    """
    return "10" + str(round(math.log10(value))).translate(SUPERSCRIPT) if value > 0 else ""


def series(rows: Sequence[Rate], game: str, measure: str) -> Line:
    """The frames consumed per second by number of envs, of one game."""
    rates = Line()
    for row in rows:
        if (row.game, row.measure) == (game, measure):
            rates[row.num_envs] = row.frames_per_s_with_check
    return dict(sorted(rates.items()))


def mean_series(rows: Sequence[Rate], games: Sequence[str], measure: str) -> Line:
    """Mean rate over games, at the numbers of envs that all of them were measured with."""
    lines = [series(rows, game, measure) for game in games]
    means = Line()
    if lines:
        for count in sorted(set.intersection(*map(set, lines))):
            means[count] = float(np.mean([line[count] for line in lines]))
    return means


def _line(axis: Any, rates: Mapping[int, float], **look: Any) -> None:
    if rates:
        axis.plot(list(rates), list(rates.values()), **look)


def hyperparameters(options: TableOptions, progress: Progress | None) -> Made:
    """``hyperparameters``: CSV and Markdown, and the table as a picture; one column an algorithm.

    Generated from the configs themselves, so that it cannot go stale.
    """
    columns = dict[str, dict[str, str]]()
    if options.paper:
        notes = [
            f"total_frames is that of {TrainConfig().env}; the paper's budget depends on the game"
        ]
        for algorithm in ALGORITHMS:
            config = preset("paper", algorithm=algorithm).to_dict()
            columns[algorithm] = _settings([config], algorithm)
    else:
        runs = find_runs(options.runs)
        notes = list(runs.notes)
        for algorithm, configs in _configs_by_algorithm(runs.runs).items():
            columns[algorithm] = _settings(configs, algorithm)
    names = list(dict.fromkeys(chain.from_iterable(columns.values())))
    if not names:
        raise ValueError(
            f"the runs below {options.runs[0]} say nothing of their settings: nothing to draw"
        )
    head = ["setting", *columns]
    table = list[list[str]]()
    for name in names:
        values = [column.get(name, "") for column in columns.values()]
        table.append([name, *values])
    base, endings = options.path("hyperparameters")
    files = []
    if len(endings) > 1 or ".md" in endings:
        file = base.with_name(f"{base.name}.md")
        files.append(write_atomic(file, markdown_table(head, table) + "\n"))
    rows = [dict(zip(head, line, strict=True)) for line in table]
    picture = Picture("hyperparameters", _table_figure(head, table), rows=rows)
    return Made([picture], notes, files=files)


def _configs_by_algorithm(runs: Sequence[Run]) -> dict[str, list[Mapping[str, Any]]]:
    """Sort the configs of runs by their algorithm."""
    configs: dict[str, list[Mapping[str, Any]]] = {}
    for run in runs:
        algorithm = str(run.config.get("algorithm", "pqn"))
        configs.setdefault(algorithm, []).append(run.config)
    return configs


def _table_figure(head: Sequence[str], table: Sequence[Sequence[str]]) -> Any:
    """Draw a table as a picture."""
    size = (2.8 + 2.6 * (len(head) - 1), 0.26 * (len(table) + 2))
    figure, axes = style.panels(1, 1, size)
    axis = axes[0, 0]
    axis.set_axis_off()
    drawn = axis.table(table, colLabels=head, bbox=(0, 0, 1, 1), cellLoc="left", edges="horizontal")
    drawn.auto_set_font_size(False)
    for (line, _), cell in drawn.get_celld().items():
        cell.set_edgecolor("#d0d0d0")
        cell.set_text_props(weight="normal" if line else "bold")
    return figure


def _settings(configs: Sequence[Mapping[str, Any]], algorithm: str) -> dict[str, str]:
    """The value of every setting, or all its values where runs differ; without the settings of
    other algorithms.
    """
    default = _flat_settings(TrainConfig().to_dict(), algorithm)
    settings_of_runs = [_flat_settings(config, algorithm) for config in configs]
    values = dict[str, str]()
    for name in dict.fromkeys(chain.from_iterable(settings_of_runs)):
        # a run that does not name a setting was trained with its default
        unnamed = default.get(name, "-")
        different = {settings.get(name, unnamed) for settings in settings_of_runs}
        values[name] = " / ".join(sorted(different))
    return values


def _flat_settings(config: Mapping[str, Any], algorithm: str) -> dict[str, str]:
    """The settings of a config as text, nested names joined by dots."""
    left_out = {*NOT_SETTINGS, *ALGORITHMS} - {algorithm}
    kept = {name: value for name, value in config.items() if name not in left_out}
    settings = dict[str, str]()
    for name, value in flatten(kept).items():
        if value != {}:
            # 0 and 0.0 are the same number
            settings[name.removeprefix(f"{algorithm}.")] = str(plain_number(value))
    return settings
