"""``arcade-torch bench NAME``, ``bench all`` and ``bench compare``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import check_writable, write_atomic, write_json
from arcade_torch.tools.bench import registry
from arcade_torch.tools.files import Table, format_value, write_csv
from arcade_torch.tools.options import Command
from arcade_torch.tools.options import parse as parse_options
from arcade_torch.tools.text import say, warn


@dataclass
class Bench(Command):
    """One benchmark and its options."""

    name: str
    options: Any

    @classmethod
    def parse(cls, words: Sequence[str], prog: str) -> "Bench":
        """Read the options of one benchmark; what comes before the first flag are the memory
        models.
        """
        name = prog.split()[-1]
        if words and not words[0].startswith("-") and name in ("memory", "recall"):
            words = ["--memories", *words]
        words = ["--memories" if word == "--memory" else word for word in words]
        return cls(name, parse_options(registry.module_of(name).Options, words, prog))

    def run(self) -> int:
        """Measure, print, save."""
        out = self.options.out
        if out is not None:
            endings = (".csv",) if self.options.resumable else (".csv", ".json")
            allowed = f"a file that ends in {' or '.join(endings)}"
            require(out.suffix in endings, "--out", str(out), allowed)
            check_writable(out)
        results = registry.measure({self.name: self.options}, "one", _log)
        for name, table in results["tables"].items():
            title, key, _ = registry.TABLES[name]
            columns = list(table["rows"][0])
            cells = [list(map(format_value, row.values())) for row in table["rows"]]
            names = next(place for place, column in enumerate(columns) if column not in key)
            Table(title, columns, cells, left=names).show()
        say(registry.named(results["settings"][self.name]))
        say(registry.named(results["machine"]))
        if out is not None and not self.options.resumable:
            for path in _save(out, results):
                say(path)
        return 0

    def resume_hint(self) -> str:
        """What an interruption left."""
        if self.options.resumable:
            return f"finished rows are in {self.options.out}; the same command goes on"
        return "nothing was kept"


@dataclass
class BenchAll(Command):
    """Every benchmark into one file with machine, versions and commit, and a page of its tables.

    arcade-torch bench compare says what became of an older file.

    Example: arcade-torch bench all --size quick --out results/bench.json --page results/bench.md
    """

    size: Literal["tiny", "quick", "full"] = "quick"
    """How much: tiny takes half a minute and proves nothing, quick about ten minutes, full an hour
    or more.
    """
    benches: tuple[Literal["envs", "train", "memory", "recall"], ...] = (
        "envs",
        "train",
        "memory",
        "recall",
    )
    """Which of them."""
    out: Path = Path("results/bench.json")  # The file; overwritten.
    page: Path | None = None  # Markdown page of the tables; beside the file by default.

    def run(self) -> int:
        """Measure and save."""
        require(self.out.suffix == ".json", "--out", str(self.out), "a file that ends in .json")
        page = self.page or self.out.with_suffix(".md")
        for file in (self.out, page):
            check_writable(file)
        sizes = registry.SIZES[self.size]
        options: dict[str, Any] = {
            name: registry.module_of(name).Options(**sizes.get(name, {}), out=None)
            for name in self.benches
        }
        results = registry.measure(options, self.size, _log)
        say(write_json(self.out, results))
        say(write_atomic(page, registry.page(results)))
        return 0


@dataclass
class BenchCompare(Command):
    """What became better or worse between two JSON files of bench, number by number; exit code 1 if
    something is worse.

    Example: arcade-torch bench compare results/bench.json runs/bench.json --tolerance 0.2
    """

    old: tyro.conf.Positional[Path]  # The file to compare with.
    new: tyro.conf.Positional[Path]  # The file to judge.
    # Share by which a number may be worse; machines that are not quiet need more.
    tolerance: float = 0.2

    def run(self) -> int:
        """Compare and print."""
        require(0 < self.tolerance < 1, "--tolerance", self.tolerance, "between 0 and 1")
        old = registry.read_results(self.old)
        new = registry.read_results(self.new)
        for line in registry.differences(old, new):
            say(line)
        changes = registry.compare(old, new, self.tolerance)
        for verdict in ("worse", "missing", "better", "new"):
            for line in changes[verdict]:
                say(f"{verdict}: {line}")
        print(", ".join(f"{len(lines)} {verdict}" for verdict, lines in changes.items()))
        return 1 if changes["worse"] else 0


def _log(text: str) -> None:
    warn(f"measuring {text}")


def _save(out: Path, results: Mapping[str, Any]) -> list[Path]:
    """One JSON file, or a CSV file a table that repeats in every row the settings and what is known
    of the machine.
    """
    if out.suffix == ".json":
        return [write_json(out, results)]
    (settings,) = results["settings"].values()
    about = settings | results["machine"]
    paths = []
    for name, table in results["tables"].items():
        path = out if len(results["tables"]) == 1 else out.with_name(f"{out.stem}_{name}.csv")
        paths.append(write_csv(path, [_beside(row, about) for row in table["rows"]]))
    return paths


def _beside(row: Mapping[str, Any], about: Mapping[str, Any]) -> dict[str, Any]:
    """A row and beside it what it does not say itself; where several values were asked for, a
    row says which one is its own.
    """
    columns = dict(row)
    for name, value in about.items():
        if name not in row and not isinstance(value, list):
            columns[name] = value
    return columns
