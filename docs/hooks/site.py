"""What MkDocs calls while it builds the site: pages from elsewhere in the repository, facts, links,
formulas.
"""

from pathlib import Path
from typing import Any

import facts
import formulas
import links
import notebooks
import reference
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
SOURCES: dict[str, str] = {}
"""Page of the site to the file of the repository that it was made from, for what does not lie in
docs/.
"""


def on_config(config: Any) -> Any:
    """Add examples and the reference to the navigation."""
    books = [links.place(f"{links.NOTEBOOKS}{path.name}") for path in _notebooks()]
    config.nav.append(
        {"Examples": ["notebooks.md", *books, *(f"examples/{path.stem}.md" for path in _scripts())]}
    )
    config.nav.append({"API": reference.navigation(ROOT)})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add what does not lie in docs/: pages of the repository, notebooks, linked scripts and files,
    the reference.
    """
    for source, at in links.PAGES.items():
        if source.endswith(".md"):
            _add(files, config, at, (ROOT / source).read_text(encoding="utf-8"), source)
    _add_notebooks(files, config)
    for path in _scripts():
        _add(files, config, f"examples/{path.stem}.md", notebooks.script_page(path))
    for at, text in reference.pages(ROOT).items():
        _add(files, config, at, text)
    for source in _linked(files):
        at = links.place(source)
        if files.get_file_from_path(at) is not None:
            continue
        if (ROOT / source).is_file():
            _add(files, config, at, (ROOT / source).read_bytes())
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Insert facts, then lead links to where their targets lie on the site."""
    at = page.file.src_uri
    if at.startswith(("api/", "notebooks/")):
        return markdown
    return links.rewrite(facts.insert(markdown), SOURCES.get(at, f"docs/{at}"), at)


def on_page_content(html: str, **_: Any) -> str:
    """Draw formulas, and let wide tables scroll by themselves."""
    return formulas.to_mathml(html)


def _add(
    files: Files, config: Any, at: str, content: str | bytes, source: str | None = None
) -> None:
    if source is not None:
        SOURCES[at] = source
    files.append(File.generated(config, at, content=content))


def _add_notebooks(files: Files, config: Any) -> None:
    lines = [
        "# Notebooks",
        "",
        "Each from training to figure in a few minutes on a CPU, shown with what it printed and "
        "drew.",
        "",
    ]
    for path in _notebooks():
        text, pictures = notebooks.notebook_page(path)
        _add(files, config, f"notebooks/{path.stem}.md", text)
        for name, data in pictures.items():
            _add(files, config, f"notebooks/{name}", data)
        for kept in (path, path.with_suffix(".py")):
            _add(files, config, f"notebooks/{kept.name}", kept.read_bytes())
        title = text.partition("\n")[0].lstrip("# ")
        lines.append(f"- [{title}](notebooks/{path.stem}.md)")
    _add(files, config, "notebooks.md", "\n".join(lines) + "\n")
    SOURCES["notebooks.md"] = "docs/notebooks.md"


def _notebooks() -> list[Path]:
    return sorted((ROOT / links.NOTEBOOKS).glob("*.ipynb"))


def _scripts() -> list[Path]:
    return sorted((ROOT / "examples").glob("*.py"))


def _linked(files: Files) -> list[str]:
    found: dict[str, None] = {}
    for file in files.documentation_pages():
        if not file.src_uri.startswith(("api/", "notebooks")):
            source = SOURCES.get(file.src_uri, f"docs/{file.src_uri}")
            text = facts.MARK.sub("", file.content_string)
            found |= dict.fromkeys(
                path for path in links.targets(text, source) if not path.startswith("docs/")
            )
    return list(found)
