"""One machine-readable file with all benchmark tables, its page, and the comparison of two such files.

::

    {"format": 1, "machine": {...}, "size": "quick",
     "tables": {"envs": {"rows": [{"game": ..., "num_envs": 128, "frames_per_s": 22000.0}, ...]}, ...}}
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arcade_torch.tools.files import read_json

FORMAT = 1


@dataclass(frozen=True)
class Number:
    """A measured column.

    Attributes:
        unit: of its numbers.
        more_is_better: whether a larger number is the better one.
    """

    unit: str
    more_is_better: bool


@dataclass(frozen=True)
class Kind:
    """A table of the file.

    Attributes:
        title: what it measures.
        key: columns that say what a row is about.
        numbers: measured columns.
    """

    title: str
    key: tuple[str, ...]
    numbers: Mapping[str, Number]


_RATE, _MS = Number("frames/s", True), Number("ms", False)
TABLES: dict[str, Kind] = {
    "envs": Kind(
        "Environments: frames per second, every frame consumed",
        ("game", "obs_size", "num_envs", "measure"),
        {"frames_per_s": _RATE},
    ),
    "train": Kind(
        "Training with PQN: frames per second",
        ("network", "memory", "num_envs", "num_steps"),
        {"collect_fps": _RATE, "learn_fps": _RATE, "train_fps": _RATE},
    ),
    "models": Kind(
        "Memory models over whole sequences",
        ("model", "form", "layers", "steps"),
        {"forward_ms": _MS, "both_ms": _MS, "peak_mib": Number("MiB", False)},
    ),
    "scans": Kind(
        "The linear scan in every form",
        ("form", "steps", "numbers"),
        {"forward_ms": _MS, "both_ms": _MS},
    ),
    "recall": Kind(
        "Delayed recall: right answers, and processor time until they were right",
        ("model", "delay", "hidden_size", "seed"),
        {"accuracy": Number("share", True), "seconds": Number("s", False)},
    ),
}
"""What a file may hold; whoever adds a benchmark adds its table here."""


@dataclass(frozen=True)
class Change:
    """One number in two files.

    Attributes:
        table: its table.
        row: what the row is about.
        column: the number.
        unit: of both.
        old: value in the old file; None where only the new one has it.
        new: value in the new file; None where it is missing.
        ratio: how much better the new one is, above 1 is better; 1 where one is missing.
    """

    table: str
    row: str
    column: str
    unit: str
    old: float | None
    new: float | None
    ratio: float

    def verdict(self, tolerance: float) -> str:
        """``better``, ``worse``, ``same``, ``missing`` or ``new``.

        Args:
            tolerance: share by which a number may be worse (or has to be better to be called so), in (0, 1).
        """
        if self.old is None or self.new is None:
            return "new" if self.old is None else "missing"
        if self.ratio < 1 - tolerance:
            return "worse"
        return "better" if self.ratio > 1 / (1 - tolerance) else "same"

    def line(self) -> str:
        """The change in words."""
        values = " -> ".join("none" if value is None else f"{value:,.4g}" for value in (self.old, self.new))
        return f"{self.table}: {self.row}: {self.column} {values} {self.unit} (x {self.ratio:.2f})"


def read_results(path: Path) -> dict[str, Any]:
    """Read a file of ``arcade-torch bench all``.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is something else, or of another format; one line.
    """
    values = read_json(path)
    if not isinstance(values, dict) or values.get("format") != FORMAT or not isinstance(values.get("tables"), dict):
        raise ValueError(f"{path} is no file of `arcade-torch bench all` in format {FORMAT}")
    if not isinstance(values.get("machine"), dict) or not isinstance(values.get("size"), str):
        raise ValueError(f"{path} does not say on which machine and at what size it was measured")
    for name, table in values["tables"].items():
        if name not in TABLES:
            raise ValueError(f"{path} has an unknown table {name!r}; known are {', '.join(TABLES)}")
        rows = table.get("rows") if isinstance(table, dict) else None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError(f"{path}: table {name} has no list of rows")
        _check_rows(path, name, rows)
    return values


def _check_rows(path: Path, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    kind, seen = TABLES[name], set[str]()
    for row in rows:
        if missing := [column for column in (*kind.key, *kind.numbers) if column not in row]:
            raise ValueError(f"{path}: a row of table {name} has no {missing[0]}")
        for column in kind.numbers:
            value = row[column]
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e15:
                raise ValueError(
                    f"{path}: {name}, {about(name, row)}: {column} is {value!r}, wanted a number from 0 up"
                )
        if about(name, row) in seen:
            raise ValueError(f"{path}: table {name} has two rows for {about(name, row)}")
        seen.add(about(name, row))


def about(name: str, row: Mapping[str, Any]) -> str:
    """What a row is about, in one line."""
    return " ".join(", ".join(f"{column} {row[column]}" for column in TABLES[name].key).split())


def compare(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[Change]:
    """Number by number, what became of an old file in a new one.

    Args:
        old: from `read_results`.
        new: from `read_results`.

    Returns:
        Every number that one of them has, in the order of the old file, then what is new.
    """
    before, after = dict(_numbers(old)), dict(_numbers(new))
    found = []
    for key in dict.fromkeys((*before, *after)):
        table, row, column = key
        number = TABLES[table].numbers[column]
        ratio = _ratio(before.get(key), after.get(key), number.more_is_better)
        found.append(Change(table, row, column, number.unit, before.get(key), after.get(key), ratio))
    return found


def _numbers(results: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str, str], float]]:
    for name, table in results["tables"].items():
        for row in table["rows"]:
            for column in TABLES[name].numbers:
                yield (name, about(name, row), column), float(row[column])


def _ratio(old: float | None, new: float | None, more_is_better: bool) -> float:
    if old is None or new is None or old == new:
        return 1.0
    better, worse = (new, old) if more_is_better else (old, new)
    return better / worse if worse else math.inf


def page(results: Mapping[str, Any]) -> str:
    """All tables as one Markdown page."""
    machine = ", ".join(f"{name} {value}" for name, value in results["machine"].items() if value)
    lines = ["# Benchmarks", "", f"`make bench`, size {results['size']}. {machine}.", ""]
    for name, table in results["tables"].items():
        kind = TABLES[name]
        lines += [f"## {kind.title}", ""]
        heads = [*kind.key, *(f"{column} ({number.unit})" for column, number in kind.numbers.items())]
        lines += ["| " + " | ".join(heads) + " |", "|---" * len(kind.key) + "|---:" * len(kind.numbers) + "|"]
        for row in table["rows"]:
            cells = [_cell(row[column]) for column in (*kind.key, *kind.numbers)]
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value).replace("|", "\\|")
