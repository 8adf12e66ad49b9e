"""What the documentation says is run: examples, commands, links, tables."""

import doctest
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")])
LINKED = ("envs_jax", "models", "agents", "tools")
FENCE = re.compile(r"^```(?P<language>\w+)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(path: Path, language: str) -> list[tuple[int, str]]:
    """The fenced blocks of a page in one language, each with the line it begins at."""
    text = path.read_text(encoding="utf-8")
    found = FENCE.finditer(text)
    return [(text[: m.start()].count("\n") + 2, m["code"]) for m in found if m["language"] == language]


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def section(path: Path, title: str) -> str:
    """The part of a page below one heading."""
    return path.read_text(encoding="utf-8").split(f"\n## {title}\n")[1].split("\n## ")[0]


def first_cells(text: str) -> list[str]:
    """What stands in backquotes in the first column of a table."""
    return re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)


def documented_modules() -> list[str]:
    """Modules with examples in their docstrings, found without importing them."""
    sources = list((ROOT / "arcade_torch").glob("*.py"))
    for folder in LINKED:
        sources += (ROOT / folder).rglob("*.py")
    found = []
    for path in sources:
        if ">>> " in path.read_text(encoding="utf-8"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found.append(".".join(parts if parts[0] == "arcade_torch" else ("arcade_torch", *parts)))
    return sorted(module.removesuffix(".__init__") for module in found)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name)
def test_the_python_examples_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__example__"}
    for line, code in blocks(page, "python"):
        # Blank lines in front: a traceback names the line of the page.
        exec(compile("\n" * (line - 1) + code, str(page), "exec"), namespace)


def test_the_readme_has_examples_of_environment_collector_and_memory() -> None:
    code = "".join(code for _, code in blocks(ROOT / "README.md", "python"))
    for needed in ("arcade_torch.make(", "ArcadeCollector(", "make_memory("):
        assert needed in code


@pytest.mark.parametrize("module", documented_modules())
def test_the_examples_in_docstrings_run(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    result = doctest.testmod(importlib.import_module(module), optionflags=flags)
    assert result.attempted > 0, f"{module} has an example that no docstring holds"
    assert result.failed == 0, "see the captured output"


def test_every_make_target_that_is_named_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        code = [code for _, code in blocks(page, "bash")] + re.findall(r"`(make [a-z-]+[^`]*)`", text)
        for target in re.findall(r"^make ([a-z-]+)", "\n".join(code), re.MULTILINE):
            assert target in targets, f"{name(page)} names `make {target}`, the Makefile has {sorted(targets)}"


def commands() -> list[tuple[str, ...]]:
    """Every `arcade-torch` command on any page, with its options."""
    lines = {line for page in PAGES for _, code in blocks(page, "bash") for line in code.splitlines()}
    split = (tuple(shlex.split(line, comments=True)) for line in lines)
    return sorted(words[1:] for words in split if words and words[0] == "arcade-torch")


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_every_command_that_is_named_exists_with_its_options(words: tuple[str, ...]) -> None:
    options = [word.split("=")[0] for word in words if word.startswith("--") and word != "--help"]
    command = []
    for word in words:
        if not re.fullmatch(r"[a-z][a-z-]*", word):
            break
        command.append(word)
    result = subprocess.run(
        [sys.executable, "-m", "arcade_torch.tools", *command, "--help"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert " ".join(command) in result.stdout
    for option in options:
        assert option in result.stdout


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path) if path else page
        assert linked.exists(), f"{name(page)} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in anchors, f"{name(page)} links to {target}"


def test_the_table_of_environments_is_true() -> None:
    from arcade_torch.envs_jax import make, registered_ids

    text = (ROOT / "docs/environments.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([^`]+-v\d+)` \| (\d+) \| (-?[\d.]+) \| (-?[\d.]+) \|$", text, re.MULTILINE)
    assert sorted(row[0] for row in rows) == registered_ids()
    for id, limit, lowest, highest in rows:
        game = make(id)
        assert game.max_steps == int(limit), id
        assert game.return_range == pytest.approx((float(lowest), float(highest)), abs=5e-5), id


@pytest.mark.parametrize("table", ["metrics.csv", "eval.csv"])
def test_the_columns_in_the_glossary_are_those_that_are_written(table: str) -> None:
    from arcade_torch.agents.run_folder import EVAL_COLUMNS, METRIC_COLUMNS

    written = {"metrics.csv": METRIC_COLUMNS, "eval.csv": EVAL_COLUMNS}[table]
    assert tuple(first_cells(section(ROOT / "docs/glossary.md", table))) == written


def test_every_layer_and_name_of_the_readme_exists() -> None:
    import arcade_torch.models as models

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert set(models.memory_names()) >= {"lru", "mingru", "gru", "mlp"}
    for public in re.findall(r"`(MemoryModule|register_memory|make_memory)`", text):
        assert hasattr(models, public)
    for folder in first_cells(section(ROOT / "docs/architecture.md", "Layers")):
        assert (ROOT / folder.rstrip("/")).is_dir()
