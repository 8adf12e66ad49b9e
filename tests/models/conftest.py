"""Shared by the model tests."""

import pytest
import torch


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """Random inputs are the same on every run and for every order of the tests."""
    torch.manual_seed(0)
