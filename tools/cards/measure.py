"""Everything that a card says of a memory model, as plain values for a JSON file."""

import inspect
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import arcade_torch
from arcade_torch.models import RecurrentMemory, law_results, make_memory
from arcade_torch.models.generators import kept_generators
from arcade_torch.models.presets import PRESETS
from arcade_torch.models.registry import is_built_in
from arcade_torch.tools.bench import recall
from arcade_torch.tools.bench.memory import (
    ACTING_ENVS,
    MINIBATCH_STEPS,
    memory_cost,
    time_memories,
)
from arcade_torch.tools.bench.memory_tests import TESTS, table
from arcade_torch.tools.bench.memory_tests.training import Setting
from arcade_torch.tools.cards import reach
from arcade_torch.tools.errors import one_line
from arcade_torch.tools.files import read_rows
from arcade_torch.tools.machine import torch_threads, versions

FORMAT = 1
WIDTHS = {"small": PRESETS["small"].hidden_size, "paper": PRESETS["paper"].hidden_size}
"""Widths of a cell in the networks of the presets."""
LAW_SIZES = (8, 16)  # of input and output, when laws are checked
REACH_WIDTH = 32  # of input and output, for what `reach` measures
RIVALS = ("gru", "lru")
"""What speed is compared with, in the same run and in turns."""
DELAYS = (8, 32, 96)
"""Of delayed recall."""
RECALL_S = 10.0
"""Budget of a training in delayed recall, processor time, where none is on file; there it was
60 s."""
SETTING = Setting(steps=800)
"""How the tests of memory are trained: as those on file."""
ON_FILE = Path(arcade_torch.__file__).resolve().parents[1] / "results"
"""Measurements of the built-in models, in a checkout of the repository."""

Tell = Callable[[str], None]


def measure_card(name: str, tests: bool = True, tell: Tell = lambda part: None) -> dict[str, Any]:
    """Measure a memory model.

    Args:
        name: of a registered memory model.
        tests: train it in delayed recall and in the tests that separate memories, where there are
            no results of a built-in model on file; about a minute.
        tell: called with a word before each part.

    Returns:
        Values for a JSON file, ``study`` None: numbers, words, lists and tables. Where a part
        fails, it holds ``error``, the reason in a line.

    Raises:
        ValueError, TypeError: there is no such model, or it cannot be made.
    """
    memory = make_memory(name, *LAW_SIZES)
    card: dict[str, Any] = {
        "format": FORMAT,
        "name": name,
        "built_in": is_built_in(name),
        "about": _about(memory),
        "versions": versions(),
    }
    with torch_threads(1), kept_generators(seed=0):
        for part, measure in (
            ("laws", _laws),
            ("cost", _cost),
            ("speed", _speed),
            ("reach", _reach),
            ("context", _context),
        ):
            tell(part)
            card[part] = _or_error(measure, name)
        card["recall"] = _recall(name, tests, tell)
        card["tests"] = _tests(name, tests, tell)
    card["study"] = None
    return card


def _about(memory: torch.nn.Module) -> str:
    """What the file of a memory model, or else its class, says in its first paragraph; of a module
    of another library what its class says.
    """
    kind = type(memory)
    text = getattr(inspect.getmodule(kind), "__doc__", None) or kind.__doc__ or ""
    if isinstance(memory, RecurrentMemory):
        kind = type(memory.module)
        text = kind.__doc__ or kind.__name__
        # those of torch begin with the arguments
        text = re.sub(r"^\s*__init__\(.*?\)\n\n", "", text, flags=re.DOTALL)
    return " ".join(text.strip().partition("\n\n")[0].replace("``", "").split())


def _or_error(measure: Callable[[str], Any], name: str) -> Any:
    """What is measured, or why it cannot be: a model of a user's may fail anywhere."""
    try:
        return measure(name)
    except Exception as error:
        return {"error": f"{type(error).__name__}: {one_line(error)}"}


def _laws(name: str) -> list[dict[str, Any]]:
    """The laws of `check_memory`, one by one."""
    rows = []
    for result in law_results(make_memory(name, *LAW_SIZES), input_size=LAW_SIZES[0]):
        row = result._asdict()
        row["discrepancy"] = _number(result.discrepancy)
        rows.append(row)
    return rows


def _cost(name: str) -> dict[str, dict[str, int]]:
    """Parameters, state and arithmetic of a cell, for each of `WIDTHS`."""
    costs = {}
    for preset, width in WIDTHS.items():
        cost = memory_cost(make_memory(name, width, width), width)
        costs[preset] = {"width": width} | cost._asdict()
    return costs


def _speed(name: str) -> dict[str, Any]:
    """Microseconds of a step of one environment, beside those of `RIVALS`."""
    width = WIDTHS["small"]
    names = list(dict.fromkeys([name, *RIVALS]))
    rows = {}
    for model, (acting, learning) in time_memories(names, width, seconds=0.1).items():
        rows[model] = {"acting_us": _number(acting), "learning_us": _number(learning)}
    return {
        "width": width,
        "acting_envs": ACTING_ENVS,
        "learning_steps": MINIBATCH_STEPS,
        "threads": 1,
        "us_a_step": rows,
    }


def _reach(name: str) -> dict[str, Any]:
    """Gradient reach of a new model."""
    measured = reach.gradient_reach(make_memory(name, REACH_WIDTH, REACH_WIDTH))
    return {
        "norms": [_number(norm) for norm in measured.norms.tolist()],
        "tenth": measured.horizon(0.1),
        "hundredth": measured.horizon(0.01),
    }


def _context(name: str) -> dict[str, Any]:
    """Context length of a new model."""
    measured = reach.context_length(make_memory(name, REACH_WIDTH, REACH_WIDTH))
    return {
        "steps": measured.steps,
        "exact": measured.exact,
        "longest": measured.longest,
        "threshold": reach.THRESHOLD,
        "text": measured.text,
    }


def _recall(name: str, train: bool, tell: Tell) -> list[dict[str, Any]]:
    """Share of right answers in delayed recall, by delay."""
    on_file = _on_file(name, "recall_cpu.csv", recall.Recall)
    rows = []
    for delay in DELAYS:
        asked = [row for row in on_file if row.delay == delay and row.hidden_size == 64]
        if not asked and not train:
            continue
        if not asked:
            tell(f"delayed recall, {delay} steps")
            asked = [recall.train(name, delay, seconds=RECALL_S)]
        row = asked[0]
        rows.append(
            {
                "delay": delay,
                "accuracy": row.accuracy,
                "solved": row.accuracy >= recall.SOLVED,
                "steps": row.steps,
                "seconds": row.seconds,
            }
        )
    return rows


def _tests(name: str, train: bool, tell: Tell) -> list[dict[str, Any]]:
    """The row of a model in the heat map of the tests that separate memories."""
    on_file = _on_file(name, "memory_tests.csv", table.Row)
    rows = list[table.Row]()
    for test in TESTS.values():
        asked = [row for row in on_file if row.test == test.name]
        asked = [row for row in asked if row.most_steps == SETTING.steps]
        if {row.level for row in asked} != set(test.tested):
            if not train:
                continue
            asked = list(table.measured(None, [name], [test], [0], SETTING, tell))
        rows += asked
    cells = table.cells(rows)
    by_cell = []
    for test, level in table.columns(rows):
        cell = cells[name, test.name, level]
        by_cell.append(
            {
                "test": test.name,
                "level": level,
                "unit": test.level,
                "new": level > max(test.trained),
                "chance": _number(float(test.chance)),
                "accuracy": _number(cell.accuracy),
                "score": _number(cell.score),
                "verdict": cell.verdict,
                "seeds": cell.seeds,
            }
        )
    return by_cell


def _on_file(name: str, file: str, kind: Any) -> list[Any]:
    """The rows of a built-in model in the results of this repository; none elsewhere."""
    path = ON_FILE / file
    if not is_built_in(name) or not path.is_file():
        return []
    return [row for row in read_rows(path, kind) if row.model == name]


def _number(value: float) -> float | None:
    """Four digits of a number; None for NaN, which JSON has not."""
    return None if math.isnan(value) else float(f"{value:.4g}")
