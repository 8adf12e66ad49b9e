"""What the documentation says is run: examples, commands, links, tables."""

import doctest
import importlib
import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from arcade_torch.models import registry
from arcade_torch.tools import cli
from arcade_torch.tools.imports import take_imports

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "results").glob("*.md"), *(ROOT / "docs").rglob("*.md")]
)
LINKED = ("envs_jax", "models", "agents", "tools")
SLOW = "<!-- slow -->"
FENCE = re.compile(
    rf"(?P<slow>^{SLOW}\n)?^(?P<indent> *)```(?P<language>\w+)\n(?P<code>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
INLINE = re.compile(r"(?<!`)`arcade-torch ([^`]+)`(?!`)")
PLACEHOLDER = re.compile(
    r"[A-Z][A-Z_]+$"
)  # a word such as NAME or COMMAND stands for something else


class Block(NamedTuple):
    line: int
    code: str
    slow: bool


def fenced(text: str, language: str) -> list[Block]:
    """The fenced blocks of a page in one language; what stands below `SLOW` takes long."""
    found = [match for match in FENCE.finditer(text) if match["language"] == language]
    return [
        Block(text[: m.start("code")].count("\n") + 1, m["code"], bool(m["slow"])) for m in found
    ]


def blocks(path: Path, language: str) -> list[tuple[int, str]]:
    """The fenced blocks of a page in one language, each with the line it begins at."""
    return [block[:2] for block in fenced(path.read_text(encoding="utf-8"), language)]


def without_code(text: str) -> str:
    """A page without its fenced blocks: what stands there is no heading and no link."""
    return FENCE.sub("", text)


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
            found.append(
                ".".join(parts if parts[0] == "arcade_torch" else ("arcade_torch", *parts))
            )
    return sorted(module.removesuffix(".__init__") for module in found)


def python_pages() -> list[object]:
    """Pages with Python on them; those with a block that takes long are left to `make
    test-slow`.
    """
    found = {page: fenced(page.read_text(encoding="utf-8"), "python") for page in PAGES}
    return [
        pytest.param(
            page, id=name(page), marks=[pytest.mark.slow] * any(block.slow for block in found[page])
        )
        for page in PAGES
        if found[page]
    ]


@pytest.mark.parametrize("page", python_pages())
def test_the_python_examples_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        registry, "_FACTORIES", dict(registry._FACTORIES)
    )  # a page may register a model of its own
    namespace: dict[str, object] = {"__name__": "__example__"}
    for line, code in blocks(page, "python"):
        # Blank lines in front: a traceback names the line of the page.
        exec(compile("\n" * (line - 1) + code, str(page), "exec"), namespace)


def test_a_block_below_the_mark_is_slow_and_every_block_is_found() -> None:
    text = (
        "a\n```python\n1\n```\n<!-- slow -->\n```python\n2\n```\n- item\n\n  ```python\n  3\n  "
        "```\n"
    )
    assert [(block.line, block.slow) for block in fenced(text, "python")] == [
        (3, False),
        (7, True),
        (12, False),
    ]
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert len(re.findall(r"^ *```\w", text, re.MULTILINE)) == len(FENCE.findall(text)), name(
            page
        )


def test_the_readme_has_examples_of_environment_collector_and_memory() -> None:
    code = "".join(code for _, code in blocks(ROOT / "README.md", "python"))
    for needed in ("arcade_torch.make(", "ArcadeCollector(", "make_memory("):
        assert needed in code


@pytest.mark.parametrize("module", documented_modules())
def test_the_examples_in_docstrings_run(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    result = doctest.testmod(importlib.import_module(module), optionflags=flags)
    assert result.attempted > 0, f"{module} has an example that no docstring holds"
    assert result.failed == 0, "see the captured output"


def test_every_make_target_that_is_named_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        code = [code for _, code in blocks(page, "bash")] + re.findall(
            r"`(make [a-z-]+[^`]*)`", text
        )
        for target in re.findall(r"^make ([a-z-]+)", "\n".join(code), re.MULTILINE):
            assert target in targets, (
                f"{name(page)} names `make {target}`, the Makefile has {sorted(targets)}"
            )


def command_lines() -> list[tuple[str, ...]]:
    """Every `arcade-torch` command in a shell block of any page, with its options."""
    code = [code for page in PAGES for _, code in blocks(page, "bash")]
    lines = {line for text in code for line in text.replace("\\\n", " ").splitlines()}
    split = (shlex.split(line, comments=True) for line in lines)
    return sorted(
        {
            tuple(words[words.index("arcade-torch") + 1 :])
            for words in split
            if "arcade-torch" in words
        }
    )


@pytest.mark.parametrize("words", command_lines(), ids=" ".join)
def test_every_command_is_one_that_the_parser_takes(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    imports, rest = take_imports(list(words))
    assert all(Path(path).is_file() for path in imports)
    command, options = cli.split_command(rest)
    try:
        cli.command_class(command).parse(options, f"arcade-torch {command}")
    except SystemExit as stop:
        assert "--help" in options and not stop.code


def test_the_parser_refuses_what_does_not_exist() -> None:
    with pytest.raises(ValueError, match="--stepps"):
        cli.command_class("list").parse(["--stepps", "3"], "arcade-torch list")


def test_every_command_in_a_sentence_exists() -> None:
    groups = {command.split()[0] for command in cli.COMMANDS if " " in command}
    for page in PAGES:
        for text in INLINE.findall(without_code(page.read_text(encoding="utf-8"))):
            words = text.split()
            if not (
                any(map(PLACEHOLDER.match, words[:2]))
                or words[0].startswith("-")
                or (words[:1] == words and words[0] in groups)
            ):
                cli.split_command(words)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as they are made on the site and by hosts of
    repositories.
    """
    headings = re.findall(
        r"^#+ (.*)$", without_code(page.read_text(encoding="utf-8")), re.MULTILINE
    )
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text(encoding="utf-8"))):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists() and linked.is_relative_to(ROOT), f"{name(page)} links to {target}"
        assert not anchor or anchor in anchors(linked), f"{name(page)} links to {target}"


def test_files_of_the_repository_that_a_page_names_are_there() -> None:
    folders = ("agents", "arcade_torch", "envs_jax", "models", "tools", "tests", "examples")
    ours = re.compile(rf"`((?:{'|'.join(folders)})/[\w/.-]+\.\w+)`")
    for page in PAGES:
        if page.name == "CHANGELOG.md":  # what it names was there once
            continue
        for path in ours.findall(page.read_text(encoding="utf-8")):
            assert (ROOT / path).exists(), f"{name(page)} names {path}"


def test_the_index_of_results_names_all_of_them() -> None:
    index = (ROOT / "results/README.md").read_text(encoding="utf-8")
    made_by_hand = {"README.md", "gpu.md", "bench.json", "bench.md"}  # the last three by make
    for path in (ROOT / "results").iterdir():
        stem = path.name.rpartition(".")[0] or path.name
        assert path.name in made_by_hand or stem in index, f"results/README.md: {path.name}"


def test_the_table_of_environments_is_true() -> None:
    from arcade_torch.envs_jax import make, registered_ids

    text = (ROOT / "docs/environments.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `([^`]+-v\d+)` \| (\d+) \| (-?[\d.]+) \| (-?[\d.]+) \|$", text, re.MULTILINE
    )
    assert sorted(row[0] for row in rows) == registered_ids()
    for id, limit, lowest, highest in rows:
        game = make(id)
        assert game.max_steps == int(limit), id
        assert game.return_range == pytest.approx((float(lowest), float(highest)), abs=5e-5), id


def test_the_kinds_of_memory_on_the_page_are_those_of_the_games() -> None:
    from arcade_torch.envs_jax import make
    from arcade_torch.envs_jax.game import MEMORY_KINDS
    from arcade_torch.envs_jax.registry import GAMES, PROBES

    text = (ROOT / "docs/environments.md").read_text(encoding="utf-8")
    on_page = dict(
        re.findall(r"^\| \[(\w+)\]\(games/\w+\.md\) \| .+ \| (\w+) \|$", text, re.MULTILINE)
    )
    kinds = {name: make(f"{name}Easy").memory_kind for name in GAMES | PROBES}
    assert on_page == kinds
    assert set(kinds.values()) == set(MEMORY_KINDS)
    assert all(f"*{kind}*" in text for kind in MEMORY_KINDS)


@pytest.mark.parametrize("table", ["metrics.csv", "eval.csv"])
def test_the_columns_in_the_glossary_are_those_that_are_written(table: str) -> None:
    from arcade_torch.agents.runs.folder import EVAL_COLUMNS, METRIC_COLUMNS

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


def test_the_files_of_a_step_are_those_of_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    import arcade_torch
    from arcade_torch import compiled

    part = section(ROOT / "docs/architecture.md", "One step of an environment")
    rows = [path.replace("<game>", "minesweeper") for path in first_cells(part)]
    monkeypatch.setattr(compiled, "_compile", compiled._compile.__wrapped__)  # compile it anew
    env = arcade_torch.make("MineSweeperEasy", num_envs=2)
    root = env.rand_action(env.reset())
    seen: dict[str, None] = {}

    def note(frame: Any, event: str, argument: object) -> None:
        seen.setdefault(frame.f_code.co_filename)

    sys.setprofile(note)
    try:
        env.step(root)
    finally:
        sys.setprofile(None)
    ours = [file for file in seen if "site-packages" not in file and not file.startswith("<")]
    paths = [Path(file).resolve() for file in ours]
    opened = [path.relative_to(ROOT).as_posix() for path in paths if path.is_relative_to(ROOT)]
    assert [path for path in opened if path in rows] == rows
    others = {path.removeprefix("arcade_torch/") for path in opened if path not in rows}
    assert others - {"tests/test_docs.py"} <= set(re.findall(r"`([\w/]+\.py)`", part))


def test_the_presets_on_the_page_are_those_that_there_are() -> None:
    from arcade_torch.agents import preset, preset_names

    text = (ROOT / "docs/guides/training.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| (\w+) \| ([\d,]+) \|", text, re.MULTILINE)
    assert sorted(row[0] for row in rows) == preset_names()
    for chosen, algorithm, network, frames in rows:
        config = preset(chosen, env="SkittlesEasy")
        assert (config.algorithm, config.network) == (algorithm, network)
        assert config.total_frames == int(frames.replace(",", ""))


def test_variables_of_the_shell_that_are_read_are_on_a_page() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    reads = re.compile(r"environ(?:\.get|\.setdefault)?[(\[]\s*\"([A-Z_]+)\"")
    read = set()
    for folder in ("agents", "arcade_torch", "envs_jax", "models", "tools"):
        for path in (ROOT / folder).rglob("*.py"):
            read |= set(reads.findall(path.read_text(encoding="utf-8")))
    known_to_all = {"COLUMNS", "PYGAME_HIDE_SUPPORT_PROMPT", "PYTHONOPTIMIZE", "TERM"}
    assert len(read) > 4
    for variable in read - known_to_all:
        assert f"`{variable}" in text, variable


def test_the_keys_of_a_study_on_the_page_are_those_that_it_takes() -> None:
    from dataclasses import fields

    from arcade_torch.tools.studies.grid import Study

    part = section(ROOT / "docs/cluster.md", "The file of a study")
    first = re.findall(r"^\| (`.+?`) \|", part, re.MULTILINE)
    named = {key for cell in first for key in re.findall(r"`(\w+)`", cell)}
    assert named == {field.name for field in fields(Study)}


def test_the_arguments_of_make_on_the_page_are_those_that_it_takes() -> None:
    import inspect

    import arcade_torch

    named = first_cells(section(ROOT / "docs/environments.md", "What `make` takes"))
    taken = list(inspect.signature(arcade_torch.make).parameters)
    taken.remove("partial_obs")  # stands beside what it is an alias of
    assert named == taken


def test_the_columns_of_human_scores_on_the_page_are_those_that_are_written() -> None:
    from arcade_torch.tools.play.scores import COLUMNS

    text = (ROOT / "docs/play.md").read_text(encoding="utf-8").split("### Scores of people")[1]
    first = re.findall(r"^\| (`.+?`) \|", text, re.MULTILINE)
    assert tuple(column for cell in first for column in re.findall(r"`(\w+)`", cell)) == COLUMNS
