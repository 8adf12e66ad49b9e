"""``arcade-torch figure NAME`` and ``arcade-torch analyze NAME``: two words for one thing.

They differ in where the files go by default: ``figure`` writes into ``figures``, ``analyze`` into
the analysis folder of the first run.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import tyro

from arcade_torch.tools.commands import Command
from arcade_torch.tools.figures import FIGURES, Options, make_figure
from arcade_torch.tools.files import csv_text
from arcade_torch.tools.machine import keep_freed_memory
from arcade_torch.tools.options import parse as parse_options
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.text import say


@dataclass
class Figure(Command):
    """A figure that was asked for."""

    name: str
    options: Options

    @classmethod
    def parse(cls, words: Sequence[str], prog: str) -> "Figure":
        """Read the options of one figure; runs are named with or without ``--runs``, which goes in
        front.
        """
        _, group, name = prog.split()
        entry = FIGURES[name]
        starts = [
            0,
            *(place for place, word in enumerate(words) if word.startswith("--")),
            len(words),
        ]
        parts = sorted(
            (words[a:b] for a, b in pairwise(starts)),
            key=lambda one: not "".join(one).startswith("--runs"),
        )
        words = [
            word.removeprefix("--runs=") for part in parts for word in part if word != "--runs"
        ]
        Options.__annotations__["runs"] = tyro.conf.Positional[tuple[Path, ...]]
        entry.options.__doc__ = (
            f"{entry.summary[0].upper()}{entry.summary[1:]}.\n\nExample: {prog} {entry.example}"
        )
        options: Any = parse_options(entry.options, words, prog)
        if group == "analyze" and options.out is None and options.runs and options.runs[0].is_dir():
            first = options.runs[0]
            # of a checkpoint
            run = first.parent.parent if (first / "meta.json").is_file() else first
            options = replace(options, out=run / "analysis")
        return cls(name, options)

    def run(self) -> int:
        """Measure, draw, save, print."""
        from arcade_torch.tools.figures.style import import_matplotlib

        keep_freed_memory()
        import_matplotlib()
        with Bars() as bars:
            made = make_figure(self.name, self.options, bars.update)
        if self.options.csv:
            for line in made.notes:
                print(line, file=sys.stderr)
            print(csv_text([row for picture in made.pictures for row in picture.rows]), end="")
            return 0
        for table in made.tables:
            table.show()
        for line in [*made.notes, *map(str, made.files)]:
            say(line)
        return 0
