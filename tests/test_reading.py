"""How the code reads: one thought a line, functions that fit a screen, names that name something.

Counted with ``ast`` in the five code folders, and as far as length and assignments go in the
examples; each failure names file and line.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("envs_jax", "arcade_torch", "models", "agents", "tools")
MOST_LETTERS = 100
MOST_LINES = 60
"""Of a function, its docstring included."""
MOST_LINES_OF_A_FILE = 450
LONGER_FILES = {
    "arcade_torch/env.py": "one class, TorchRL's methods",
    "arcade_torch/collector.py": "one class, TorchRL's protocol of collectors",
    "arcade_torch/rollout_buffer.py": "one class, a window that is written, read, saved and loaded",
    "tools/measures/counterfactual/measure.py": "a measure is one file that is imported alone",
}
"""Wholes that would read worse in parts."""
MOST_PARALLEL = 3
"""Assignments ``a, b = x, y`` in 1,000 lines that are not empty: pairs by nature."""
MOST_COMPREHENSIONS = dict.fromkeys(FOLDERS, 20) | {"tools": 30}
"""In 1,000 lines that are not empty."""
NO_NAMES = set(
    [
        "found",
        "what",
        "made",
        "made_",
        "how",
        "own",
        "here",
        "each",
        "every",
        "known",
        "like",
        "shown",
        "standing",
        "told",
    ]
)
"""Words that name nothing: what is it that was found, made or told?"""
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


def files(folder: str) -> list[Path]:
    """The Python files of a code folder; the linked folders are folders of their own."""
    inside = (ROOT / folder).rglob("*.py")
    return sorted(path for path in inside if path.resolve().relative_to(ROOT).parts[0] == folder)


def nodes(folder: str) -> Iterator[tuple[str, ast.AST]]:
    """Every node that has a line, with the place where it stands."""
    for path in files(folder):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if hasattr(node, "lineno"):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def lines(folder: str) -> int:
    """Lines that are not empty."""
    texts = [path.read_text(encoding="utf-8") for path in files(folder)]
    return sum(bool(line.strip()) for text in texts for line in text.splitlines())


def is_parallel(node: ast.AST) -> bool:
    """Whether a node assigns several things at once that are not the parts of one."""
    if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Tuple):
        return False
    return isinstance(node.value, ast.Tuple | ast.GeneratorExp)


@pytest.mark.parametrize("folder", (*FOLDERS, "examples"))
def test_one_assignment_a_line(folder: str) -> None:
    wrong = [place for place, node in nodes(folder) if is_parallel(node)]
    assert len(wrong) <= MOST_PARALLEL * lines(folder) / 1000, "\n".join(wrong)


@pytest.mark.parametrize("folder", FOLDERS)
def test_comprehensions_are_rare(folder: str) -> None:
    wrong = [place for place, node in nodes(folder) if isinstance(node, COMPREHENSIONS)]
    assert len(wrong) <= MOST_COMPREHENSIONS[folder] * lines(folder) / 1000, "\n".join(wrong)


@pytest.mark.parametrize("folder", (*FOLDERS, "examples"))
def test_lines_and_functions_are_short(folder: str) -> None:
    wrong = []
    for path in files(folder):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if len(line) > MOST_LETTERS:
                wrong.append(f"{path.relative_to(ROOT)}:{number}: {len(line)} letters")
    for place, node in nodes(folder):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or node.lineno) - node.lineno
            if length > MOST_LINES:
                wrong.append(f"{place}: {node.name} has {length} lines")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("folder", FOLDERS)
def test_files_are_short_or_one_whole(folder: str) -> None:
    longer = set()
    for path in files(folder):
        if len(path.read_text(encoding="utf-8").splitlines()) > MOST_LINES_OF_A_FILE:
            longer.add(str(path.relative_to(ROOT)))
    allowed = {name for name in LONGER_FILES if name.startswith(f"{folder}/")}
    assert longer == allowed


@pytest.mark.parametrize("folder", FOLDERS)
def test_names_name_something(folder: str) -> None:
    wrong = []
    for place, node in nodes(folder):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        elif isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            name = node.name.lstrip("_")
        else:
            continue
        if name in NO_NAMES:
            wrong.append(f"{place}: {name}")
    assert not wrong, "\n".join(wrong)


def test_the_slow_cases_are_cases_of_tests_that_exist() -> None:
    cases = (ROOT / "tests/slow_cases.txt").read_text().splitlines()
    missing = []
    for case in cases:
        if case.startswith("#"):
            continue
        file, _, function = case.partition("[")[0].partition("::")
        if f"def {function}(" not in (ROOT / file).read_text():
            missing.append(case)
    assert not missing


COMMAND = re.compile(r" (python -m \S|python \S+\.py|arcade-torch [a-z]+ --)")
GAP = re.compile(r"\S {3,}(?=\S)")


def indented_blocks(text: str) -> Iterator[list[str]]:
    """Indented lines of a docstring that stand together, without those of an interpreter."""
    for paragraph in re.split(r"\n\s*\n", text):
        block = [line for line in paragraph.splitlines() if line.startswith("    ")]
        yield [line for line in block if not line.lstrip().startswith(("...", ">>>"))]


@pytest.mark.parametrize("folder", (*FOLDERS, "examples"))
def test_formulas_and_commands_in_docstrings_are_not_wrapped_into_one_another(folder):
    wrapped = []
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    for path in files(folder):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            text = (isinstance(node, kinds) and ast.get_docstring(node)) or ""
            for block in indented_blocks(text):
                columns = {gap.end() for line in block for gap in [GAP.search(line)] if gap}
                commands = [line for line in block if COMMAND.search(line.lstrip(), 1)]
                if len(columns) > 1 or any("XLA_FLAGS" not in line for line in commands):
                    wrapped.append(f"{path.relative_to(ROOT)}: {block}")
    assert not wrapped, "\n".join(wrapped)
