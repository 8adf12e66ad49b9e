"""The benchmarks by name, the file that holds their tables, its page, and the comparison of two
such files.

::

    {"format": 1, "machine": {...}, "size": "quick",
     "settings": {"memory": {"batch": 16, "size": 512, "threads": 1, ...}, ...},
     "tables": {"envs": {"rows": [{"game": ..., "num_envs": 128, "frames_per_s": 22000.0}, ...]},
     ...}}
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from arcade_torch.agents.runs.files import read_json
from arcade_torch.tools.files import format_value, markdown_table

FORMAT = 1

BENCHES = {
    "envs": "frames per second of the games, every frame consumed",
    "train": "frames per second of training, and where the time goes",
    "memory": "time of the memory models, of the scans behind them, and of saliency",
    "recall": "tests of memory: which model holds what, for how long, and what it does with it",
}
"""Name -> what it measures. A module of that name has ``Options`` (`BenchOptions`) and
``run(options, log)``, which yields ``(table, row)``."""
SIZES: dict[str, dict[str, dict[str, Any]]] = {
    "tiny": {
        "envs": {"games": ("SignpostEasy",), "batches": (2,), "seconds": 0.01, "repeats": 1},
        "train": {"networks": ("small",), "memories": ("mlp",), "grad_steps": 1, "repeats": 1},
        "memory": {
            "memories": ("gru",),
            "steps": (8,),
            "layers": (1,),
            "size": 8,
            "batch": 2,
            "frames": 4,
            "seconds": 0.01,
            "repeats": 1,
        },
        "recall": {"memories": ("gru",), "delays": (2,), "seconds": 0.5},
    },
    "quick": {
        "envs": {"batches": (16, 128), "seconds": 0.2, "repeats": 3},
        "train": {"networks": ("small",), "grad_steps": 2},
        "memory": {"steps": (132,), "layers": (1,), "seconds": 0.2, "repeats": 2},
        "recall": {"memories": ("lru", "mingru", "gru"), "delays": (8,), "seconds": 10.0},
    },
    "full": {"envs": {"sizes": (128, 256)}},
}
"""Size of ``bench all`` -> the options of each benchmark that differ from its own."""


@dataclass
class BenchOptions:
    """Options that every benchmark has."""

    resumable: ClassVar[bool] = False
    out: Path | None = None
    """File for the numbers, .json or .csv (of several tables one file each, its name added);
    overwritten.
    """
    # Have the C library keep freed memory, as train does and a loop of your own does not.
    keep_memory: bool = False


class Kind(NamedTuple):
    """A table: what it measures, columns that say what a row is about, measured columns and their
    units.
    """

    title: str
    key: tuple[str, ...]
    numbers: dict[str, str]


MACHINE = ("processor", "cores", "jax_device", "keep_memory")
"""What must be the same of two machines whose numbers are compared."""
MORE_IS_BETTER = ("frames/s", "share")
_TIMES = {"forward_ms": "ms", "both_ms": "ms"}
TABLES: dict[str, Kind] = {
    "envs": Kind(
        "Environments: frames per second, every frame consumed",
        ("game", "obs_size", "num_envs", "measure"),
        {"frames_per_s": "frames/s"},
    ),
    "train": Kind(
        "Training with PQN: frames per second",
        ("network", "memory", "form", "num_envs", "num_steps"),
        dict.fromkeys(("collect_fps", "learn_fps", "train_fps"), "frames/s"),
    ),
    "models": Kind(
        "Memory models over whole sequences", ("model", "form", "layers", "steps"), _TIMES
    ),
    "scans": Kind("The linear scan in every form", ("form", "steps", "numbers"), _TIMES),
    "saliency": Kind(
        "Saliency of one decision, small network", ("way", "frames"), {"both_ms": "ms"}
    ),
    "recall": Kind(
        "Delayed recall: right answers, and processor time until they were right",
        ("model", "delay", "hidden_size", "seed"),
        {"accuracy": "share", "seconds": "s"},
    ),
    "memory_tests": Kind(
        "Tests of memory: right answers",
        ("model", "test", "level", "seed", "hidden_size", "most_steps"),
        {"accuracy": "share", "seconds": "s"},
    ),
}
"""What a file may hold; whoever adds a benchmark adds its tables here."""


def module_of(name: str) -> Any:
    """The module of a benchmark: ``Options``, ``run``."""
    return import_module(f"arcade_torch.tools.bench.{name}")


def measure(
    benches: Mapping[str, BenchOptions], size: str, log: Callable[[str], None]
) -> dict[str, Any]:
    """Run benchmarks one after another, those that keep freed memory last; the content of a file,
    four digits.
    """
    import torch

    from arcade_torch.tools.machine import keep_freed_memory, machine

    tables: dict[str, Any] = {}
    settings: dict[str, dict[str, Any]] = {}
    kept = [name for name, options in benches.items() if options.keep_memory]
    for name in sorted(benches, key=kept.__contains__):
        if name in kept:
            keep_freed_memory()
        settings[name] = _settings(benches[name])
        for table, row in module_of(name).run(benches[name], log):
            # a benchmark that sets torch's threads has them set between its rows
            settings[name]["threads"] = torch.get_num_threads()
            short = {}
            for key, value in row.items():
                short[key] = float(f"{value:.4g}") if isinstance(value, float) else value
            tables.setdefault(table, {"rows": []})["rows"].append(short)
    about = machine() | {"keep_memory": ", ".join(kept) or "no"}
    del about["torch_threads"]  # of the process; a benchmark's own are among its settings
    return {
        "format": FORMAT,
        "machine": about,
        "size": size,
        "settings": settings,
        "tables": tables,
    }


def _settings(options: BenchOptions) -> dict[str, Any]:
    """Options as JSON has them, without files, and without ``keep_memory``, which the machine's
    line tells.
    """
    settings = {}
    for name, value in vars(options).items():
        if name != "keep_memory" and not isinstance(value, Path):
            settings[name] = list(value) if isinstance(value, tuple) else value
    return settings


def named(values: Mapping[str, Any]) -> str:
    """Names and values on one line, without those that are empty."""
    words = []
    for name, value in values.items():
        text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
        if value is not None and text:
            words.append(f"{name} {text}")
    return ", ".join(words)


def read_results(path: Path) -> dict[str, Any]:
    """Read a file of ``arcade-torch bench all``; a ``ValueError`` if it is none, or a number in it
    is none.
    """
    values = read_json(path)
    if (
        not isinstance(values, dict)
        or values.get("format") != FORMAT
        or not isinstance(values.get("tables"), dict)
    ):
        raise ValueError(f"{path} is no file of `arcade-torch bench all` in format {FORMAT}")
    if not isinstance(values.get("machine"), dict) or not isinstance(values.get("size"), str):
        raise ValueError(f"{path} does not say on which machine and at what size it was measured")
    settings = values.setdefault("settings", {})  # a file from before they were kept has none
    if not isinstance(settings, dict) or not all(isinstance(x, dict) for x in settings.values()):
        raise ValueError(f"{path}: settings must be a table of options for each benchmark")
    try:
        _numbers(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return values


def _numbers(results: Mapping[str, Any]) -> dict[tuple[str, str, str], float]:
    """Every measured number of a file by table, what its row is about, and column."""
    numbers_of_rows: dict[tuple[str, str, str], float] = {}
    for name, table in results["tables"].items():
        if name not in TABLES:
            raise ValueError(f"unknown table {name!r}; known are {', '.join(TABLES)}")
        rows = table.get("rows") if isinstance(table, dict) else None
        kind = TABLES[name]
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError(f"table {name} has no list of rows")
        for row in rows:
            for column in (*kind.key, *kind.numbers):
                if column not in row:
                    raise ValueError(f"a row of table {name} has no {column}")
            keys = ", ".join(f"{column} {row[column]}" for column in kind.key)
            subject = " ".join(keys.split())  # on one line
            for column in kind.numbers:
                value = row[column]
                if not _is_measured(value):
                    raise ValueError(
                        f"{name}, {subject}: {column} is {value!r}, wanted a number from 0 up"
                    )
                if (name, subject, column) in numbers_of_rows:
                    raise ValueError(f"table {name} has two rows for {subject}")
                numbers_of_rows[name, subject, column] = float(value)
    return numbers_of_rows


def _is_measured(value: Any) -> bool:
    """Whether a value is a number that a benchmark can have measured."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and 0 <= value < 1e15


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """What of two files' machines, and of the settings of benchmarks that both have, is not the
    same: a line for each.
    """
    lines = [_difference("machine", old["machine"], new["machine"], MACHINE)]
    for name, was in old["settings"].items():
        if name in new["settings"]:
            now = new["settings"][name]
            lines.append(_difference(f"settings of {name}", was, now, [*(was | now)]))
    return [line for line in lines if line]


def _difference(
    subject: str, was: Mapping[str, Any], now: Mapping[str, Any], names: Sequence[str]
) -> str:
    """What of some names has another value, on one line; empty if nothing has."""
    differs = []
    for name in names:
        if was.get(name) != now.get(name):
            differs.append(f"{name} {was.get(name)} and {now.get(name)}")
    return f"not the same {subject}: {', '.join(differs)}" if differs else ""


def compare(
    old: Mapping[str, Any], new: Mapping[str, Any], tolerance: float
) -> dict[str, list[str]]:
    """What became of an old file in a new one: verdict -> a line for each number; a share of
    tolerance is the same.
    """
    before = _numbers(old)
    after = _numbers(new)
    verdicts: dict[str, list[str]] = {
        "same": [],
        "worse": [],
        "better": [],
        "missing": [],
        "new": [],
    }
    for key in before | after:
        table, row, column = key
        was = before.get(key)
        now = after.get(key)
        unit = TABLES[table].numbers[column]
        ratio = 1.0
        if was is None:
            verdict = "new"
        elif now is None:
            verdict = "missing"
        else:
            ratio = _improvement(was, now, unit)
            verdict = _verdict(ratio, tolerance)
        values = f"{_short(was)} -> {_short(now)}"
        verdicts[verdict].append(f"{table}: {row}: {column} {values} {unit} (x {ratio:.2f})")
    return verdicts


def _improvement(was: float, now: float, unit: str) -> float:
    """How many times as good a number has become."""
    if was == now:
        return 1.0
    good, bad = (now, was) if unit in MORE_IS_BETTER else (was, now)
    return good / bad if bad else math.inf


def _verdict(ratio: float, tolerance: float) -> str:
    """One word for an improvement; a share of tolerance is the same."""
    if ratio < 1 - tolerance:
        return "worse"
    if ratio > 1 / (1 - tolerance):
        return "better"
    return "same"


def _short(value: float | None) -> str:
    """A number with four digits."""
    return "none" if value is None else f"{value:,.4g}"


def page(results: Mapping[str, Any]) -> str:
    """All tables as one Markdown page."""
    about = f"`make bench`, size {results['size']}. {named(results['machine'])}."
    lines = ["# Benchmarks", "", about, ""]
    lines += [f"- {name}: {named(settings)}" for name, settings in results["settings"].items()]
    lines += [""] if results["settings"] else []
    for name, table in results["tables"].items():
        title, key, numbers = TABLES[name]
        heads = [*key, *(f"{column} ({unit})" for column, unit in numbers.items())]
        rows = [[format_value(row[column]) for column in (*key, *numbers)] for row in table["rows"]]
        lines += [f"## {title}", "", markdown_table(heads, rows, left=len(key)), ""]
    return "\n".join(lines)
