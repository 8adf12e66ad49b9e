"""All fuzzing is slow; at the end the counts are printed, and written to the file that FUZZ_TABLE names."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.fuzz import contract


@pytest.fixture(scope="session", autouse=True)
def _table_of_inputs() -> Iterator[None]:
    yield
    if contract.counts and (name := os.environ.get("FUZZ_TABLE")):
        Path(name).write_text(
            "# Fuzzing\n\nWritten by `FUZZ_TABLE=results/fuzz.md make test-slow ARGS=tests/fuzz`: generated inputs by "
            "entry point.\nEach of them worked or was refused in one line of ours; see `tests/fuzz/contract.py`.\n\n"
            f"{contract.table()}\n",
            encoding="utf-8",
        )


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if contract.counts:
        terminalreporter.section("inputs generated")
        terminalreporter.write_line(contract.table())
