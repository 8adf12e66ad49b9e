"""``arcade-torch figure NAME`` and ``arcade-torch analyze NAME``: two words for one thing.

They differ in where the files go by default: ``figure`` writes into ``figures``, ``analyze`` into the analysis folder
of the first run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from arcade_torch.tools.figures import FIGURES, Options, make_figure
from arcade_torch.tools.options import parse as parse_options


@dataclass
class Figure:
    """A figure that was asked for."""

    name: str
    options: Options
    argv: tuple[str, ...] = ()

    def run(self) -> int:
        """Measure, draw, save, print."""
        from arcade_torch.tools.files import csv_text
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.optional import need
        from arcade_torch.tools.progress import Bars

        keep_freed_memory()
        need("matplotlib")
        with Bars() as bars:
            made = make_figure(self.name, self.options, bars.update)
        if self.options.csv:
            rows = [row for picture in made.pictures for row in picture.rows]
            print(csv_text(rows, list(dict.fromkeys(name for row in rows for name in row))), end="")
            return 0
        for table in made.tables:
            table.show()
        for line in [*made.notes, *map(str, made.files)]:
            print(line)
        return 0


COMMANDS = {"figure": Figure}


def parse(words: Sequence[str], prog: str) -> Figure:
    """Read the options of one figure; runs are named with or without ``--runs``."""
    _, group, name = prog.split()
    entry = FIGURES[name]
    words = [word.removeprefix("--runs=") for word in words if word != "--runs"]
    Options.__annotations__["runs"] = tyro.conf.Positional[tuple[Path, ...]]
    entry.options.__doc__ = f"{entry.summary[0].upper()}{entry.summary[1:]}.\n\nExample: {prog} {entry.example}"
    options: Any = parse_options(entry.options, words, prog)
    if options.out is None and group == "analyze":
        options = replace(options, out=_analysis_folder(options.runs))
    return Figure(name, options)


def _analysis_folder(runs: Sequence[Path]) -> Path | None:
    """Where figures about a run folder, a checkpoint or a study go by default; None for other files."""
    if not runs or not runs[0].is_dir():
        return None
    return (runs[0].parent.parent if (runs[0] / "meta.json").is_file() else runs[0]) / "analysis"
