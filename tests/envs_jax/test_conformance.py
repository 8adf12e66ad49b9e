"""The page on conformance names tests that exist, and has a line for every game."""

import re
from pathlib import Path

import pytest

from .conftest import ALL_IDS

TESTS = Path(__file__).resolve().parents[1]
PAGE = (TESTS.parent / "docs/conformance.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`([\w/]+\.py)::(test_\w+)`", PAGE)))


def test_tests_are_named_at_all():
    assert len(NAMED) > 50
    rows = [
        line
        for line in PAGE.splitlines()
        if line.startswith("| ") and not line.startswith("| what")
    ]
    assert all("::test_" in row or "below" in row for row in rows if not row.startswith("| game"))


@pytest.mark.parametrize(("file", "test"), NAMED)
def test_a_named_test_exists(file, test):
    path = TESTS / file if "/" in file else TESTS / "envs_jax" / file
    assert f"\ndef {test}(" in path.read_text(encoding="utf-8")


def test_every_game_has_lines():
    families = {re.sub(r"(Easy|Medium|Hard)-v\d+$", "", id) for id in ALL_IDS}
    assert families == set(re.findall(r"^\| ([A-Z]\w+) \|", PAGE, re.MULTILINE))
