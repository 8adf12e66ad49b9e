"""Fuzzing is slow, but for a few inputs of each test, which run with the fast tests.

At the end of the slow run the counts are printed, and written to the file that FUZZ_TABLE names.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from arcade_torch.tools.files import write_between
from tests.fuzz import contract


def pytest_configure(config: pytest.Config) -> None:
    """See what kind of run this is, before the tests are read."""
    contract.few = "not slow" in config.getoption("markexpr")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let files that are slow as a whole run with few inputs; a test that is slow by itself stays
    so.
    """
    if not contract.few:
        return
    folder = Path(__file__).parent
    for item in items:
        module = item.getparent(pytest.Module)
        if module is not None and folder in item.path.parents:
            module.own_markers[:] = [mark for mark in module.own_markers if mark.name != "slow"]


@pytest.fixture(scope="session", autouse=True)
def _table_of_inputs() -> Iterator[None]:
    yield
    if contract.counts and not contract.few and (name := os.environ.get("FUZZ_TABLE")):
        write_between(Path(name), "<!-- inputs -->", "<!-- end of inputs -->", contract.table())


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if contract.counts and not contract.few:
        terminalreporter.section("inputs generated")
        terminalreporter.write_line(contract.table())
