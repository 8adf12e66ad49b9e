"""Results of the tests of memory: rows of a file that is gone on with, verdicts, a Markdown
table.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

from arcade_torch.tools.bench.memory_tests import TESTS
from arcade_torch.tools.bench.memory_tests.batch import MemoryTest
from arcade_torch.tools.bench.memory_tests.training import Setting, Trained, train
from arcade_torch.tools.files import markdown_table, read_rows, write_csv
from arcade_torch.tools.measures.bootstrap import pooled

__all__ = ["BEGIN", "END", "Cell", "Row", "cells", "columns", "markdown", "measured"]

BEGIN = "<!-- memory tests -->"
END = "<!-- end of memory tests -->"

# of what a guess misses, the share that is right, as a mean over seeds
SOLVED = 0.95  # from here on
AT_CHANCE = 0.05  # up to here


class Row(NamedTuple):
    """What one model reached with one seed in one test at one size."""

    model: str
    test: str
    level: int
    seed: int
    hidden_size: int
    most_steps: int  # of training; the key ends here
    accuracy: float  # share of right answers on fresh data, to four places
    answers: int
    steps: int  # of training, until it was solved or they were spent
    seconds: float  # processor time of these steps
    parameters: int
    state_numbers: int


class Cell(NamedTuple):
    """One model in one test at one size, over seeds."""

    accuracy: float
    low: float
    high: float
    """Ends of the bootstrap interval over seeds; NaN with one seed."""
    score: float
    """Share of what a guess misses that is right: 0 is chance, 1 is all."""
    seeds: int

    @property
    def verdict(self) -> str:
        """ "solved", "chance" or "partly"."""
        if self.score >= SOLVED:
            return "solved"
        return "chance" if self.score <= AT_CHANCE else "partly"


def measured(
    path: Path | None,
    memories: Sequence[str],
    tests: Sequence[MemoryTest],
    seeds: Sequence[int],
    setting: Setting,
    log: Callable[[str], None],
) -> Iterator[Row]:
    """The rows of every model, test and seed, seed after seed: those that a CSV file holds, the
    others measured and added to it.

    Args:
        path: the file; None keeps nothing.
        memories: names of models.
        tests: what they are asked.
        seeds: of weights and data.
        setting: of the training.
        log: is called with a line before each training.
    """
    rows = read_rows(path, Row) if path is not None and path.exists() else []
    for seed, memory, test in product(seeds, memories, tests):
        key = (seed, setting.hidden_size, setting.steps)
        asked = [row for row in rows if row[:2] == (memory, test.name) and row[3:6] == key]
        if {row.level for row in asked} != set(test.tested):
            log(f"{memory}, {test.name}, seed {seed}")
            asked = _rows(memory, test, seed, setting, train(memory, test, seed, setting))
            rows += asked
            if path is not None:
                write_csv(path, [row._asdict() for row in rows], Row._fields)
        yield from asked


def _rows(
    memory: str, test: MemoryTest, seed: int, setting: Setting, trained: Trained
) -> list[Row]:
    """One training as rows, one a size."""
    _, *rest = trained
    rows = []
    for level, (accuracy, answers) in trained.accuracy.items():
        key = (memory, test.name, level, seed, setting.hidden_size, setting.steps)
        rows.append(Row(*key, round(accuracy, 4), answers, *rest))  # type: ignore[arg-type]
    return rows


def columns(rows: Sequence[Row]) -> list[tuple[MemoryTest, int]]:
    """The tests and sizes that rows are about, in the order of `TESTS`."""
    present = {(row.test, row.level) for row in rows}
    pairs = []
    for test in TESTS.values():
        pairs += [(test, level) for level in test.tested if (test.name, level) in present]
    return pairs


def cells(rows: Sequence[Row]) -> dict[tuple[str, str, int], Cell]:
    """Model, test and size -> the mean over seeds, with its 95 % interval."""
    shares: dict[tuple[str, str, int], list[float]] = {}
    for row in rows:
        shares.setdefault((row.model, row.test, row.level), []).append(row.accuracy)
    table = {}
    for key, values in shares.items():
        over_seeds = pooled(values)
        chance = float(TESTS[key[1]].chance)
        mean = float(over_seeds.mean)
        ends = (float(over_seeds.low), float(over_seeds.high))
        table[key] = Cell(mean, *ends, (mean - chance) / (1 - chance), len(values))
    return table


def markdown(rows: Sequence[Row], models: Sequence[str]) -> str:
    """The rows as a Markdown table: a line a test and size, a column a model."""
    table = cells(rows)
    lines = []
    for test, level in columns(rows):
        new = "" if level <= max(test.trained) else ", new"
        line = [f"`{test.name}`", f"{level} {test.level}{new}", f"{100 * float(test.chance):.1f}"]
        for model in models:
            cell = table.get((model, test.name, level))
            line.append("" if cell is None else _in_words(cell))
        lines.append(line)
    heads = ["test", "size", "chance", *(f"`{model}`" for model in models)]
    return markdown_table(heads, lines, left=2)


def _in_words(cell: Cell) -> str:
    """Per cent of right answers, bold where solved, in brackets at chance, with its interval."""
    share = f"{100 * cell.accuracy:.0f}"
    text = {"solved": f"**{share}**", "chance": f"({share})", "partly": share}[cell.verdict]
    if cell.high - cell.low >= 0.02:
        text = f"{text} [{100 * cell.low:.0f}, {100 * cell.high:.0f}]"
    return text
