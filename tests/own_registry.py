"""A fixture for tests that register games of their own."""

import sys
from collections.abc import Iterator

import gymnasium
import pytest
from gymnasium.envs import registration

from arcade_torch.envs_jax import registry
from arcade_torch.tools.imports import VARIABLE


def forget_games(monkeypatch: pytest.MonkeyPatch) -> None:
    """Games that are registered from now on are forgotten after the test."""
    for table in ("_ENTRIES", "_ALIASES"):
        monkeypatch.setattr(registry, table, dict(getattr(registry, table)))
    theirs = dict(gymnasium.registry)
    monkeypatch.setattr(gymnasium, "registry", theirs)
    monkeypatch.setattr(registration, "registry", theirs)


@pytest.fixture
def own_registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever a test registers or imports is forgotten after it."""
    forget_games(monkeypatch)
    monkeypatch.setenv(VARIABLE, "")
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "REGISTERS", False) or name.startswith("own_game"):
            del sys.modules[name]
