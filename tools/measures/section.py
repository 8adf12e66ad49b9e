"""A report's section on one measure: a row of a table for every cell, a picture for every task."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from arcade_torch.tools.figures import Progress, style
from arcade_torch.tools.measures.checkpoints import measure_run

# (agent, game, twin) -> folders of its finished runs
Cells = Mapping[tuple[str, str, str], Sequence[Path]]


def section(
    name: str,
    cells: Cells,
    measure: tuple[Callable[..., Any], Mapping[str, Any]],
    summary: Callable[[Any], tuple[Any, dict[str, Any]]],
    plot: Callable[[Any, Any], None],
    ylabel: str,
    progress: Progress | None,
) -> dict[str, Any]:
    """Measure every cell for a row of the table, and draw the agents of each task in one picture;
    notes on the rest.
    """
    pictures = list[str]()
    rows = list[dict[str, Any]]()
    notes = list[str]()
    drawn = dict[tuple[str, str, str], Any]()
    for (agent, game, twin), paths in cells.items():
        tell = partial(progress, f"{name}, {agent} on {game}") if progress else None
        try:
            measured = [measure_run(path, *measure, tell) for path in paths]
            drawn[agent, game, twin], row = summary(measured)
        except ValueError as error:  # episodes too short
            notes.append(f"{agent} on {game} {style.TWIN_NAMES[twin]}: {error}")
        else:
            rows.append({"agent": agent, "game": game, "twin": style.TWIN_NAMES[twin]} | row)
    for (game, twin), by_agent in style.agents_by_task(drawn).items():
        figure, axes = style.panels(1, 1, style.SMALL_PANEL)
        axis = axes[0, 0]
        plot(by_agent, axis)
        title = f"{game}, {style.TWIN_NAMES[twin]}"
        axis.set(title=title, ylabel=ylabel)
        pictures.append(style.svg(figure, f"{name} {title}"))
    return {"pictures": pictures, "rows": rows, "notes": notes}
