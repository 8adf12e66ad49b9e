"""All benchmarks one after another, at one of three sizes, into one file."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Literal

from arcade_torch.tools.bench.results import FORMAT, TABLES

Size = Literal["tiny", "quick", "full"]
Tell = Callable[[str], None]

SIZES: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "tiny": {
        "envs": {"games": ("SignpostEasy",), "batches": (2,), "seconds": 0.01, "repeats": 1},
        "train": {"networks": ("small",), "memories": ("mlp",), "grad_steps": 1, "repeats": 1},
        "models": {
            "names": ("gru",),
            "steps": (8,),
            "layers": (1,),
            "size": 8,
            "batch": 2,
            "seconds": 0.01,
            "repeats": 1,
        },
        "scans": {"steps": (8,), "size": 8, "batch": 2, "seconds": 0.01, "repeats": 1},
        "recall": {"memories": ("gru",), "delays": (2,), "seconds": 0.5},
    },
    "quick": {
        "envs": {"batches": (16, 128), "seconds": 0.2, "repeats": 3},
        "train": {"networks": ("small",), "memories": ("lru", "gru"), "grad_steps": 2, "repeats": 3},
        "models": {"steps": (132,), "layers": (1,), "seconds": 0.2, "repeats": 2},
        "scans": {"steps": (132,), "seconds": 0.2, "repeats": 2},
        "recall": {"memories": ("lru", "mingru", "gru"), "delays": (8,), "seconds": 10.0},
    },
    "full": {
        "envs": {"sizes": (128, 256), "batches": (1, 16, 128, 512)},
        "train": {"networks": ("paper", "small"), "memories": ("lru", "gru")},
        "models": {},
        "scans": {},
        "recall": {"delays": (8, 32, 96)},
    },
}
"""Arguments of every benchmark; "quick" takes about ten minutes on two quiet cores, "tiny" shows that it works."""


def bench_all(size: Size = "quick", tables: Sequence[str] = (), tell: Tell = lambda text: None) -> dict[str, Any]:
    """Run the benchmarks.

    Args:
        size: key of `SIZES`.
        tables: which; all of ``envs train models scans recall`` by default.
        tell: called with a line before each configuration.

    Returns:
        What ``results/bench.json`` holds; see the module ``results``.

    Raises:
        ValueError: an unknown size or table.
    """
    if size not in SIZES:
        raise ValueError(f"unknown size {size!r}: allowed are {', '.join(SIZES)}")
    if unknown := [name for name in tables if name not in TABLES]:
        raise ValueError(f"unknown table {unknown[0]!r}: allowed are {', '.join(TABLES)}")
    from arcade_torch.tools.bench.envs import machine
    from arcade_torch.tools.keep_memory import keep_freed_memory

    keep_freed_memory()  # as in training
    about = machine()
    found = {name: {"rows": list(_RUN[name](dict(SIZES[size][name]), tell))} for name in tables or TABLES}
    return {"format": FORMAT, "machine": about, "size": size, "tables": found}


def _envs(how: dict[str, Any], tell: Tell) -> Iterable[dict[str, Any]]:
    from arcade_torch.envs_jax import registered_ids
    from arcade_torch.tools.bench.envs import bench_envs

    games = how.pop("games", None) or tuple(name for name in registered_ids() if "Easy" in name)
    return [_kept("envs", asdict(row)) for row in bench_envs(games, tell=tell, **how)]


def _train(how: dict[str, Any], tell: Tell) -> Iterable[dict[str, Any]]:
    from arcade_torch.tools.bench.train import bench_train

    return [_kept("train", speed.flat()) for speed in bench_train(tell=tell, **how)]


def _models(how: dict[str, Any], tell: Tell) -> Iterable[dict[str, Any]]:
    from arcade_torch.models import memory_names
    from arcade_torch.tools.bench.memory import bench_memory

    names = how.pop("names", None) or tuple(memory_names())
    return [_kept("models", asdict(row)) for row in bench_memory(names, tell=tell, **how)]


def _scans(how: dict[str, Any], tell: Tell) -> Iterable[dict[str, Any]]:
    from arcade_torch.tools.bench.scans import bench_scans

    rest: dict[str, Any] = {"steps": (132, 1024), "batch": 16, "size": 512} | how
    rows = bench_scans(rest.pop("steps"), rest.pop("batch"), rest.pop("size"), tell=tell, **rest)
    return [_kept("scans", asdict(row)) for row in rows]


def _recall(how: dict[str, Any], tell: Tell) -> Iterable[dict[str, Any]]:
    from arcade_torch.tools.bench import recall
    from arcade_torch.tools.bench.timing import torch_threads

    setting = recall.Setting(seconds=how.get("seconds", 60.0))
    cases = [(entry, delay) for entry in recall.entries(how.get("memories", ())) for delay in how["delays"]]
    with torch_threads(1):
        return [_kept("recall", asdict(row)) for row in recall.measure_all(cases, setting, tell=tell)]


_RUN: dict[str, Callable[[dict[str, Any], Tell], Iterable[dict[str, Any]]]] = {
    "envs": _envs,
    "train": _train,
    "models": _models,
    "scans": _scans,
    "recall": _recall,
}


def _kept(name: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a table, numbers with four digits."""
    kind = TABLES[name]
    numbers = {column: float(f"{row[column]:.4g}") for column in kind.numbers}
    return {column: row[column] for column in kind.key} | numbers
