"""``arcade-torch figure NAME`` and ``arcade-torch analyze NAME``: two words for one thing.

They differ in where the files go by default: ``figure`` writes into ``figures``, ``analyze`` into
the analysis folder of the first run, or for an agent of this package into ``analysis``.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro

from arcade_torch.agents.runs.shipped import agent_folder, is_shipped
from arcade_torch.tools.figures import Options
from arcade_torch.tools.figures.catalogue import FIGURES, make_figure
from arcade_torch.tools.files import csv_text
from arcade_torch.tools.machine import keep_freed_memory
from arcade_torch.tools.options import Command
from arcade_torch.tools.options import parse as parse_options
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.text import say

FigureOptions = TypeVar("FigureOptions", bound=Options)


@dataclass
class Arguments(Generic[FigureOptions]):
    """What is written behind the name of a figure."""

    options: Annotated[FigureOptions, tyro.conf.arg(name="")]
    paths: tyro.conf.Positional[tuple[Path, ...]] = ()  # The same as --runs.


@dataclass
class Figure(Command):
    """A figure that was asked for."""

    name: str
    options: Options

    @classmethod
    def parse(cls, words: Sequence[str], prog: str) -> "Figure":
        """Read the options of one figure; runs are named with or without ``--runs``."""
        _, group, name = prog.split()
        entry = FIGURES[name]
        summary = f"{entry.summary[0].upper()}{entry.summary[1:]}."
        example = f"Example: {prog} {entry.example}"
        kind: Any = Arguments
        arguments = parse_options(
            kind[entry.options], words, prog, description=f"{summary}\n\n{example}"
        )
        options: Options = arguments.options
        runs = tuple(map(agent_folder, (*options.runs, *arguments.paths)))
        options = replace(options, runs=runs)
        if group == "analyze" and options.out is None and runs and runs[0].is_dir():
            folder = Path() if is_shipped(runs[0]) else _run_folder(runs[0])
            options = replace(options, out=folder / "analysis")
        return cls(name, options)

    def run(self) -> int:
        """Measure, draw, save, print."""
        for path in self.options.runs:
            if not path.exists():  # told before anything heavy is imported
                raise FileNotFoundError(f"{path} does not exist")
        from arcade_torch.tools.figures.style import import_matplotlib

        keep_freed_memory()
        import_matplotlib()
        with Bars() as bars:
            result = make_figure(self.name, self.options, bars.update)
        if self.options.csv:
            for note in result.notes:
                print(note, file=sys.stderr)
            rows = chain.from_iterable(picture.rows for picture in result.pictures)
            print(csv_text(list(rows)), end="")
            return 0
        for table in result.tables:
            table.show()
        for note in result.notes:
            say(note)
        for file in result.files:
            say(file)
        return 0


def _run_folder(folder: Path) -> Path:
    """The folder of the run that a checkpoint belongs to; any other folder is its own."""
    is_checkpoint = (folder / "meta.json").is_file()
    return folder.parent.parent if is_checkpoint else folder
