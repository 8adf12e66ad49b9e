"""The site of `make docs`: its links, inserted facts and pictures, and that a browser needs nothing
from elsewhere.
"""

import html.parser
import importlib.util
import inspect
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from urllib.parse import unquote, urldefrag

import numpy as np
import pytest

from arcade_torch.envs_jax import probe_ids, registered_ids
from arcade_torch.envs_jax.registry import option_names
from arcade_torch.models import make_memory, memory_names
from arcade_torch.tools.play.recording import strip

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


def hook(name: str) -> ModuleType:
    """A module of docs/hooks, which is no package: MkDocs loads them by path."""
    spec = importlib.util.spec_from_file_location(
        f"docs_hooks_{name}", DOCS / "hooks" / f"{name}.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


facts, links, notebooks, reference, formulas = map(
    hook, ("facts", "links", "notebooks", "reference", "formulas")
)
MARKED = [
    page
    for page in sorted(DOCS.rglob("*.md"))
    if facts.MARK.search(page.read_text(encoding="utf-8"))
]


def in_navigation() -> list[str]:
    """The pages that mkdocs.yml names, without reading its tags for Python objects."""
    return re.findall(
        r"^ +- ([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE
    )


def test_every_page_is_in_the_navigation_once_and_every_entry_is_a_page() -> None:
    pages = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    pages |= {place for source, place in links.PAGES.items() if source.endswith(".md")}
    named = in_navigation()
    assert sorted(named) == sorted(pages)


def test_a_linked_text_of_the_repository_is_a_page() -> None:
    """A Markdown file that is only copied has links that lead nowhere; `make docs` refuses them."""
    sources = {
        page.relative_to(ROOT).as_posix(): page
        for page in (*DOCS.rglob("*.md"), *ROOT.glob("*.md"))
    }
    sources |= {source: ROOT / source for source in links.PAGES if source.endswith(".md")}
    linked = [
        path
        for source, page in sources.items()
        for path in links.targets(page.read_text("utf-8"), source)
    ]
    assert {links.place(path) for path in linked if path.endswith(".md")} <= set(in_navigation())


def test_every_game_and_every_memory_model_has_a_page() -> None:
    games = {
        re.sub(r"(Easy|Medium|Hard)-v\d+$", "", id).lower()
        for id in (*registered_ids(), *probe_ids())
    }
    assert {page.stem for page in (DOCS / "games").glob("*.md")} == games
    assert {page.stem for page in (DOCS / "memories").glob("*.md")} == set(memory_names())


def documented_options(page: Path) -> set[str]:
    """Names of options: in backquotes behind the word, or in the first column of the table of
    options.
    """
    text = page.read_text(encoding="utf-8")
    rows = "".join(
        re.findall(
            r"^\| (`.*?) \|",
            text.partition("\n## Options\n")[2].partition("\n## ")[0],
            re.MULTILINE,
        )
    )
    return set(re.findall(r"option `(\w+)`", text)) | set(re.findall(r"`(\w+)`", rows))


def test_the_options_of_every_game_are_on_its_page_and_no_others() -> None:
    for id in registered_ids():
        page = DOCS / "games" / (re.sub(r"(Easy|Medium|Hard)-v\d+$", "", id).lower() + ".md")
        assert documented_options(page) == set(option_names(id)), id


def test_the_options_of_every_memory_model_are_on_its_page_and_no_others() -> None:
    for name in memory_names():
        parameters = inspect.signature(type(make_memory(name, 2, 4))).parameters.values()
        options = {
            parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY
        }
        assert documented_options(DOCS / "memories" / f"{name}.md") == options, name


@pytest.mark.parametrize("page", MARKED, ids=lambda page: page.stem)
def test_every_inserted_fact_has_an_owner(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    inserted = facts.insert(text)
    assert not facts.MARK.search(inserted)
    assert inserted.count("\n") > text.count("\n") or "../notebooks/" in inserted


def test_an_inserted_table_has_the_rows_of_its_game_in_the_order_of_levels() -> None:
    rows = facts.fact("earned", "CartPole").splitlines()
    assert [re.match(r"\| `(\w+)-v\d", row)[1] for row in rows[2:]] == [  # type: ignore[index]
        "CartPoleEasy",
        "CartPoleMedium",
        "CartPoleHard",
    ]
    assert facts.fact("limits", "Tetris").splitlines()[2].startswith("| `TetrisEasy-v0` | 3000 |")


@pytest.mark.parametrize("kind", ["limits", "earned", "differences", "recall", "probe", "nonsense"])
def test_a_mark_without_an_owner_is_refused(kind: str) -> None:
    with pytest.raises(ValueError, match="Chess"):
        facts.insert(f"text\n<!-- insert: {kind} Chess -->\n")


def test_links_of_the_repository_become_links_of_the_site() -> None:
    readme = (
        "[a](docs/play.md#record) [b](examples/own_game.py) [c](examples/notebooks) "
        "![d](docs/a.png) [e](LICENSE)"
    )
    assert links.rewrite(readme, "README.md", "index.md") == (
        "[a](play.md#record) [b](examples/own_game.md) [c](notebooks.md) ![d](a.png) "
        "[e](files/LICENSE)"
    )
    page = "[a](../../README.md#cite) [b](../memories/lru.md) [c](#here) [d](https://x.org/a.md)"
    assert links.rewrite(page, "docs/guides/gpu.md", "guides/gpu.md") == (
        "[a](../index.md#cite) [b](../memories/lru.md) [c](#here) [d](https://x.org/a.md)"
    )
    code = "```python\nx[0](docs/play.md)\n```"
    assert (
        links.rewrite(code, "README.md", "index.md") == code
        and links.targets(code, "README.md") == []
    )


def test_a_notebook_becomes_a_page_with_its_pictures() -> None:
    text, pictures = notebooks.notebook_page(ROOT / "examples/notebooks/saliency.ipynb")
    assert text.startswith("# ") and "```python" in text
    assert all(
        data.startswith(b"\x89PNG") and f"]({name})" in text for name, data in pictures.items()
    )
    assert len(pictures) == 2


def test_the_reference_has_every_public_module() -> None:
    pages = reference.pages(ROOT)
    for name in (
        "arcade_torch",
        "arcade_torch.env",
        "arcade_torch.models.lru",
        "arcade_torch.tools.measures.gap_bias.measure",
    ):
        assert (
            f"::: {name}\n" in pages[f"api/{name}.md"] and f"]({name}.md)" in pages["api/index.md"]
        )
        assert reference.first_line(ROOT, name)
    assert not any("/_" in page or "._" in page for page in pages)


def test_the_comment_behind_a_field_is_its_docstring_in_the_reference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stand_in = SimpleNamespace(
        Extension=object, Docstring=lambda text, parent: SimpleNamespace(value=text)
    )
    monkeypatch.setitem(sys.modules, "griffe", stand_in)
    extension = hook("docstrings").OurDocstrings()
    for line, wanted in (
        ("    n: int  # how `many`", "how `many`"),
        ("    n: int", None),
        ("n = 1  # noqa: X", None),
    ):
        field = SimpleNamespace(docstring=None, lines=[line])
        extension.on_object(obj=field)
        assert getattr(field.docstring, "value", None) == wanted


def test_every_formula_becomes_mathml() -> None:
    pytest.importorskip("latex2mathml", reason="needs the docs extra: pip install '.[docs]'")
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        assert text.count("$$") % 2 == 0, page
        for formula in re.findall(r"\$\$(.*?)\$\$", text, re.DOTALL):
            made = formulas.to_mathml(f'<div class="arithmatex">\\[{formula}\\]</div>')
            assert made.startswith('<div class="formula"><math') and "arithmatex" not in made
            assert "<mi>&#x00026;</mi>" not in made and "\\" not in re.sub(r"<[^>]*>", "", made), (
                formula
            )


def strips() -> list[object]:
    """The command that drew the picture of each game's page, as the page says it."""
    found = []
    for page in sorted((DOCS / "games").glob("*.md")):
        words = shlex.split(
            re.search(
                r"^arcade-torch list sheet (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE
            )[1]
        )  # type: ignore[index]
        mark = [] if page.stem == "signpost" else [pytest.mark.slow]
        found.append(pytest.param(words, page.stem, marks=mark, id=page.stem))
    return found


@pytest.mark.parametrize(("words", "stem"), strips())
def test_the_picture_of_a_game_is_what_its_command_draws(words: list[str], stem: str) -> None:
    from PIL import Image

    steps = [int(word) for word in words[words.index("--steps") + 1 : words.index("--out")]]
    assert words[-1] == f"docs/pictures/{stem}.png"
    kept = np.asarray(Image.open(ROOT / words[-1]).convert("RGB"))
    assert np.array_equal(kept, strip(words[0], steps))


class Page(html.parser.HTMLParser):
    """Anchors of a page, where its links lead, and what a browser would load for it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors.add(given.get("id", ""))
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag in ("img", "script", "iframe", "source") and "src" in given:
            self.loads.append(given["src"])
        if tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload", "preconnect"):
            self.loads.append(given["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Page]:
    """The site, built strictly: a warning is an error."""
    pytest.importorskip("mkdocs", reason="needs the docs extra: pip install '.[docs]'")
    target = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(target)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    return {path.resolve(): Page(path) for path in target.rglob("*.html")}


@pytest.mark.slow
def test_every_link_and_picture_of_the_site_leads_somewhere(site: dict[Path, Page]) -> None:
    assert len(site) > 100
    for path, page in site.items():
        if path.name == "404.html":
            continue  # its addresses begin at the root of a server
        for target in page.links + page.loads:
            if re.match(r"(https?|mailto|data):", target):
                continue
            rest, anchor = urldefrag(unquote(target))
            linked = (path.parent / rest).resolve() if rest else path
            linked = linked / "index.html" if linked.is_dir() else linked
            assert linked.exists(), f"{path} leads to {target}"
            assert not anchor or anchor in site[linked].anchors, f"{path} leads to {target}"


@pytest.mark.slow
def test_a_page_loads_nothing_from_elsewhere(site: dict[Path, Page]) -> None:
    assert not [(path, load) for path, page in site.items() for load in page.loads if "//" in load]
    (root,) = {path.parent for path in site if path.name == "404.html"}
    assert not any(
        re.search(r"@import|url\(\s*['\"]?(https?:)?//", css.read_text())
        for css in root.rglob("*.css")
    )
