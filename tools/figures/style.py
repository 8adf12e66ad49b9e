"""How figures look, and how they are saved: the one place for colours, sizes and files."""

import math
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from io import BytesIO, StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.errors import need
from arcade_torch.tools.figures import NUMBERS, PICTURES, Options, Picture
from arcade_torch.tools.figures.fonts import save_figure
from arcade_torch.tools.files import write_csv, write_npz
from arcade_torch.tools.measures.bootstrap import Array, measured_coverage
from arcade_torch.tools.text import printable

AGENT_COLOURS = {
    "mlp": "#6b6b6b",
    "feedforward": "#9c9c9c",
    "lru": "#0072b2",
    "gru": "#009e73",
    "mingru": "#e69f00",
    "linear_transformer": "#cc79a7",
    "fart": "#cc79a7",
    "attention": "#d55e00",
    "gdn": "#56b4e9",
    "ttt": "#5e3c10",
    "tttl": "#5e3c10",
    "lstm": "#117733",
    "frame_stack": "#882255",
    "ffm": "#8fdf6f",
    "shm": "#090e9b",
    "rtu": "#740ce5",
    "deltaproduct": "#73e3bb",
    "rwkv7": "#09033f",
    "s5": "#67bf46",
    "mamba": "#807fe5",
    "slstm": "#b6de27",
    "mlstm": "#055686",
    "gtrxl": "#2c1814",
    "bmru": "#d20fb4",
    "human": "#000000",
}
"""Colours that people with the usual colour deficiencies can tell apart (after Okabe and Ito)."""

SPARE_COLOURS = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#cc79a7",
    "#56b4e9",
    "#5e3c10",
    "#000000",
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", (0, (4, 1, 1, 1, 1, 1)))  # lines that lie on one another are seen both
# recall density: the darkest is the most recent third
MDP_THIRDS = ("#c6dbef", "#6baed6", "#2171b5")
POMDP_THIRDS = ("#fdd0a2", "#fdae6b", "#e6550d")
TWIN_COLOURS = {"full": MDP_THIRDS[-1], "partial": POMDP_THIRDS[-1]}
TWIN_NAMES = {"full": "MDP", "partial": "POMDP"}
NEUTRAL = "#555555"
# inches of a picture of a report, narrow enough for its letters on a telephone; small ones for many
# tasks
PANEL = (3.9, 2.55)
SMALL_PANEL = (3.3, 2.3)

STYLES = Path(__file__).resolve().parents[1] / "data"
"""Folder of the style sheets, in matplotlib's format: light.mplstyle, and print.mplstyle for what
differs.
"""
_PLAIN = {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
"""Environment in which matplotlib can be imported."""
_OF_AXES = ("sharex", "sharey", "width_ratios", "height_ratios", "subplot_kw", "gridspec_kw")
_PRINT_SCALE = 0.62  # sizes of figures are given for a screen; on a page they are so much smaller


def import_matplotlib() -> Any:
    """Import matplotlib, also where the user's matplotlibrc file, or MPLBACKEND, holds what
    matplotlib refuses.

    The environment is left as it is, and so are settings of a matplotlib that is imported already.
    """
    try:
        return need("matplotlib")
    except ImportError:
        raise
    except Exception:
        before = {name: os.environ.get(name) for name in _PLAIN}
        os.environ.update(_PLAIN)
        for name in list(sys.modules):
            if name.startswith("matplotlib."):
                del sys.modules[name]  # left over from the import that failed
        try:
            return need("matplotlib")
        finally:
            for name, value in before.items():
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value


@contextmanager
def drawing(style: str) -> Iterator[Any]:
    """Draw in a style of ours: ``light`` for screens, ``print`` (smaller, serif) for a page.

    It begins from matplotlib's defaults, whatever the user has set, and puts the user's settings
    back. Figures are none of ``pyplot``: no window, no backend, and the user's own figures stay
    open. Gives a namespace with `subplots`.
    """
    matplotlib = import_matplotlib()
    look = dict[str, Any]()
    for name, value in matplotlib.rcParamsDefault.items():
        if not name.startswith("backend"):
            look[name] = value
    for sheet in dict.fromkeys(("light", style)):
        look |= matplotlib.rc_params_from_file(
            STYLES / f"{sheet}.mplstyle", use_default_template=False
        )
    with matplotlib.rc_context(look):
        yield SimpleNamespace(subplots=subplots)


def new_figure(**options: Any) -> Any:
    """A figure that pyplot knows nothing of; options are those of ``matplotlib.figure.Figure``."""
    return need("matplotlib.figure").Figure(**options)


def subplots(
    rows: int = 1, columns: int = 1, *, squeeze: bool = True, **options: Any
) -> tuple[Any, Any]:
    """A figure and its axes; options are those of ``matplotlib.pyplot.subplots``."""
    of_axes = dict[str, Any]()
    for name in _OF_AXES:
        if name in options:
            of_axes[name] = options.pop(name)
    figure = new_figure(**options)
    return figure, figure.subplots(rows, columns, squeeze=squeeze, **of_axes)


def panels(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Any, Any]:
    """A figure of ``size`` inches and its axes [rows, columns]; options are those of `subplots`."""
    return subplots(rows, columns, squeeze=False, figsize=size, layout="constrained", **options)


def legend_name(name: str) -> str:
    """A name as the label of an artist: matplotlib leaves labels with an underscore in front out of
    legends.
    """
    return f"\u200b{name}" if name.startswith("_") else name


def folded(name: str, letters: int = 22) -> str:
    """A name beside an axis in lines of so many letters at most, cut behind a separator if it has
    one there.

    Example:
        >>> print(folded("a_memory_whose_name_is_long", 16))
        a_memory_whose_
        name_is_long
    """
    most = f"{{1,{letters}}}"
    parts = rf".{most}$|.{{1,{letters - 1}}}[-_. ]|.{most}"
    return "\n".join(re.findall(parts, name))


def agent_markers(agents: Iterable[str], colours: Mapping[str, str]) -> dict[str, str]:
    """A marker for every agent, in whatever order they come: two that share a colour have different
    ones, up to 64 agents.
    """
    markers = dict.fromkeys(agents, "")
    taken = set[tuple[str, str]]()
    for place, agent in enumerate(sorted(markers)):
        colour = colours[agent]
        turned = [MARKERS[(place + step) % len(MARKERS)] for step in range(len(MARKERS))]
        free = [marker for marker in turned if (marker, colour) not in taken]
        markers[agent] = free[0] if free else turned[0]
        taken.add((markers[agent], colour))
    return markers


def legend_above(
    figure: Any,
    handles: Sequence[Any],
    most: int = 8,
    loc: str = "outside upper center",
    title: str = "",
) -> None:
    """Put a legend above the panels, in as many columns as its names and a title at the left leave
    room for; the figure grows with its lines. Names are text: no mathematics between dollars.
    """
    legend = figure.legend(handles=handles, loc=loc, ncols=1)
    for text in legend.get_texts():
        text.set_parse_math(False)
    size = legend.prop.get_size_in_points()
    texts = list(legend.get_texts())
    if title:
        texts.append(figure.suptitle(title, x=0.01, ha="left"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of letters that the font lacks, see `save_figure`
        widths = [72 / figure.dpi * text.get_window_extent().width for text in texts]
    title_pt = widths.pop() + 3 * size if title else 0.0
    column_pt = max(widths, default=0.0) + 5 * size  # with the sample of a line
    room = int((72 * figure.get_figwidth() - title_pt) / column_pt)
    columns = max(1, min(most, len(handles), room))
    lines = math.ceil(len(handles) / columns)
    figure.set_figheight(figure.get_figheight() + 1.6 * size / 72 * max(0, lines - 2))
    legend.remove()
    for text in figure.legend(handles=handles, loc=loc, ncols=columns).get_texts():
        text.set_parse_math(False)


def agent_colours(names: Sequence[str]) -> dict[str, str]:
    """A colour for every agent, in whatever order they come: that of its memory, or a spare one
    where there is none or another agent has it.
    """
    in_order = sorted(set(names))
    usual: dict[str, str] = {}  # of the agents whose memories have one: it is theirs
    for name in in_order:
        memory = name.lower().partition(" ")[0].rpartition("-")[2]
        colour = AGENT_COLOURS.get(memory)
        if colour is not None and colour not in usual.values():
            usual[name] = colour
    colours = dict.fromkeys(names, "")
    for place, name in enumerate(in_order):
        taken = {*usual.values(), *colours.values()}
        free = [spare for spare in SPARE_COLOURS if spare not in taken]
        spare = free[0] if free else SPARE_COLOURS[place % len(SPARE_COLOURS)]
        colours[name] = usual.get(name, spare)
    return colours


def whiskers(value: Array, low: Array, high: Array) -> Any:
    """Lengths of error bars [2, n] for matplotlib; NaN, which is not drawn, where there is no
    interval.
    """
    return np.maximum([value - low, high - value], 0.0)


def seeds_note(
    seeds: Sequence[int], confidence: float, drawn_as: str = "bars", share: float | None = None
) -> str:
    """How many seeds, which interval, and what it is worth: its coverage ``share``, that of one
    cell's mean by default.

    Example:
        >>> seeds_note([1], 0.95)
        'n = 1 seed, no interval (needs two)'
    """
    low = min(seeds)
    high = max(seeds)
    count = f"n = {low} seed{'s' * (low > 1)}" if low == high else f"n = {low} to {high} seeds"
    if high < 2:
        return f"{count}, no interval (needs two)"
    share = measured_coverage((max(low, 2),), (), confidence) if share is None else share
    return (
        f"{count}; {drawn_as}: {100 * confidence:g} % bootstrap interval over seeds, "
        f"measured coverage with {max(low, 2)} seeds {100 * share:.0f} %"
    )


def agents_by_task(
    values: Mapping[tuple[str, str, str], Any],
) -> dict[tuple[str, str], dict[str, Any]]:
    """(agent, game, twin) -> value, sorted by task: (game, twin) -> agent -> value."""
    tasks: dict[tuple[str, str], dict[str, Any]] = {}
    for (agent, game, twin), value in values.items():
        tasks.setdefault((game, twin), {})[agent] = value
    return tasks


def rows_of(**columns: Any) -> list[dict[str, Any]]:
    """Numbers of a figure: a row a cell of columns that are arrays of one shape, or single values
    for all rows.

    Example:
        >>> rows_of(agent="lru", delay=[0, 1])
        [{'agent': 'lru', 'delay': 0}, {'agent': 'lru', 'delay': 1}]
    """
    cells = [column.ravel().tolist() for column in np.broadcast_arrays(*columns.values())]
    rows = []
    for row in zip(*cells, strict=True):
        rows.append(dict(zip(columns, row, strict=True)))
    return rows


def save(options: Options, picture: Picture) -> list[Path]:
    """Write a figure with its note, and its numbers beside it."""
    base, endings = options.path(picture.name)
    figure = picture.figure
    written = list[Path]()
    if options.style == "print":
        figure.set_size_inches(_PRINT_SCALE * figure.get_size_inches())
    if picture.note:  # wrapped to the width of the figure
        label = figure.supxlabel(" ", fontsize="small", color=NEUTRAL)
        letters = int(figure.get_figwidth() * 72 / (0.56 * label.get_fontsize()))
        lines = list[str]()
        for line in picture.note.split("\n"):
            lines += textwrap.wrap(line, letters)
        label.set_text("\n".join(lines))
    for ending in endings:
        if ending in PICTURES:
            buffer = BytesIO()
            missing = save_figure(figure, buffer, format=ending[1:])
            if missing and not picture.missing:
                picture.missing = missing
            written.append(write_atomic(base.with_name(base.name + ending), buffer.getvalue()))
    if picture.rows:
        written.append(write_csv(base.with_name(base.name + ".csv"), picture.rows))
    if picture.arrays and endings != NUMBERS:
        written.append(write_npz(base.with_name(base.name + ".npz"), picture.arrays))
    return written


def svg(figure: Any, name: str) -> str:
    """A figure as an SVG element that can stand in a page beside others."""
    buffer = StringIO()
    # letters are text there: a browser has fonts of its own
    save_figure(
        figure, buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None}
    )
    text = buffer.getvalue()
    text = re.sub(
        r"<metadata>.*?</metadata>|<!--.*?-->", "", text[text.index("<svg") :], flags=re.DOTALL
    )
    text = re.sub(
        r' (?:width|height)="[\d.]+pt"| xmlns(?::xlink)?="[^"]*"| version="[\d.]+"', "", text
    )
    text = re.sub(r"-?\d+\.\d{2,}", lambda number: f"{float(number[0]):.4g}", text)
    prefix = re.sub(r"\W+", "-", name)
    text = re.sub(r">\s+<", "><", text)
    text = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{escape(printable(name))}"', 1)


def png(figure: Any) -> bytes:
    """A figure as a small PNG file of 128 colours."""
    buffer = BytesIO()
    packed = BytesIO()
    save_figure(figure, buffer, format="png", dpi=150)
    picture = need("PIL.Image").open(buffer).convert("RGB").quantize(128)
    picture.save(packed, "PNG", optimize=True)
    return packed.getvalue()
