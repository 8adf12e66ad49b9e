"""The promises of docs/versions.md that can be read from the source."""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import arcade_torch
from arcade_torch.envs_jax import registered_ids, resolve_id

ROOT = Path(__file__).resolve().parents[1]
SOURCES = [
    path
    for folder in ("arcade_torch", "envs_jax", "models", "agents", "tools")
    for path in (ROOT / folder).rglob("*.py")
]
VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)")


def release(version: str) -> tuple[int, int]:
    """The part of a version that decides about removals."""
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def faults(code: str, version: str) -> Iterator[str]:
    """What is wrong with the deprecation warnings of a source file, at a version of the package."""
    for node in ast.walk(ast.parse(code)):
        warns = isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] == "warn"
        if warns and "DeprecationWarning" in ast.unparse(node):
            named = re.search(r"removed in (\d+\.\d+)", ast.unparse(node))
            if named is None:
                yield f"line {node.lineno}: the warning names no release"
            elif release(named[1]) <= release(version):
                yield f"line {node.lineno}: this is {version}, and the thing is still there"


def test_the_version_is_a_semantic_one_and_the_changelog_is_open() -> None:
    assert VERSION.fullmatch(arcade_torch.__version__)
    headings = re.findall(
        r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert headings[0] == "Unreleased"
    released = [tuple(map(int, VERSION.fullmatch(heading).groups())) for heading in headings[1:]]  # type: ignore[union-attr]
    assert released == sorted(released, reverse=True)


def test_what_is_public_is_listed_and_can_be_imported() -> None:
    for package in ("", ".envs_jax", ".models", ".agents", ".tools"):
        module = importlib.import_module(f"arcade_torch{package}")
        assert len(module.__all__) == len(set(module.__all__)) > 0
        for name in module.__all__:
            assert hasattr(module, name) and not (name.startswith("_") and name != "__version__"), (
                package,
                name,
            )


def test_what_is_deprecated_names_a_release_that_is_still_to_come() -> None:
    found = {
        path: list(faults(path.read_text(encoding="utf-8"), arcade_torch.__version__))
        for path in SOURCES
    }
    assert len(found) > 100 and not any(found.values()), {
        path: said for path, said in found.items() if said
    }


def test_a_deprecation_that_is_late_or_open_ended_is_noticed() -> None:
    code = (
        "warnings.warn('old() is new() now; old() is removed in 0.3', DeprecationWarning, "
        "stacklevel=2)"
    )
    assert list(faults(code, "0.2.7")) == []
    assert "still there" in next(faults(code, "0.3.0"))
    assert "names no release" in next(faults(code.replace("removed in 0.3", "going away"), "0.2.7"))
    assert (
        list(faults("warnings.filterwarnings('ignore', category=DeprecationWarning)", "0.3.0"))
        == []
    )


def test_a_bare_name_is_the_newest_version_of_a_game() -> None:
    for id in registered_ids():
        name, number = id.rsplit("-v", 1)
        newest = max(
            int(other.rsplit("-v", 1)[1])
            for other in registered_ids()
            if other.rsplit("-v", 1)[0] == name
        )
        assert (resolve_id(name) == id) == (int(number) == newest)
