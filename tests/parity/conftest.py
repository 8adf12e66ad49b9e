"""Skips these tests where the published package is missing, and writes their table for ``make
parity``.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.parity.reference import missing
from tests.parity.table import Row, write

TABLE = "PARITY_TABLE"
"""Environment variable: the file to write the table into, if all tasks were walked."""

WRITTEN = pytest.StashKey[str]()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip with a reason."""
    reason = missing()
    for item in items:
        if reason and "parity" in item.keywords:
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def rows(request: pytest.FixtureRequest) -> Iterator[dict[str, Row]]:
    """What the walks found, by task; written at the end of the session."""
    found: dict[str, Row] = {}
    yield found
    if path := os.environ.get(TABLE):
        request.config.stash[WRITTEN] = write(Path(path), found)


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Print the table."""
    if WRITTEN in config.stash:
        terminalreporter.write_line(config.stash[WRITTEN])
