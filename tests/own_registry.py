"""A fixture for tests that register games of their own."""

import sys
from collections.abc import Iterator

import pytest

from arcade_torch.envs_jax import registry
from arcade_torch.tools.extensions import VARIABLE


@pytest.fixture
def own_registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever a test registers or imports is forgotten after it."""
    for table in ("_FACTORIES", "_NEWEST", "_ALIASES"):
        monkeypatch.setattr(registry, table, dict(getattr(registry, table)))
    monkeypatch.setenv(VARIABLE, "")
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "REGISTERS", False) or name.startswith("own_game"):
            del sys.modules[name]
