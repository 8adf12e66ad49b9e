"""Build the documentation: the Markdown pages as HTML, and the API reference from the docstrings.

Run by `make docs`, which writes to build/docs.
"""

import html
import pkgutil
import re
import shutil
import sys
import warnings
from importlib import import_module
from pathlib import Path

import pdoc
from markdown_it import MarkdownIt

import arcade_torch

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "index": ROOT / "README.md",
    "environments": ROOT / "docs/environments.md",
    "memories": ROOT / "docs/memories.md",
    "play": ROOT / "docs/play.md",
    "cluster": ROOT / "docs/cluster.md",
    "differences": ROOT / "docs/differences.md",
    "conformance": ROOT / "docs/conformance.md",
    "parity": ROOT / "results/parity.md",
    "architecture": ROOT / "docs/architecture.md",
    "glossary": ROOT / "docs/glossary.md",
    "changelog": ROOT / "CHANGELOG.md",
    "contributing": ROOT / "CONTRIBUTING.md",
}

STYLE = """
body { max-width: 54rem; margin: 2rem auto; padding: 0 1rem; font: 16px/1.55 system-ui, sans-serif; color: #1f2430; }
nav { border-bottom: 1px solid #d8dce3; padding-bottom: .6rem; } nav a { margin-right: 1rem; }
a { color: #1257a8; text-decoration: none; } a:hover { text-decoration: underline; }
pre { background: #f5f6f8; padding: .8rem 1rem; overflow-x: auto; border-radius: 6px; }
code { font-size: .92em; }
table { border-collapse: collapse; } th, td { border: 1px solid #d8dce3; padding: .3rem .6rem; }
"""


def page(title: str, body: str) -> str:
    """A complete HTML page with the links to all others on top."""
    links = [f'<a href="{name}.html">{"start" if name == "index" else name}</a>' for name in PAGES]
    links.append('<a href="api.html">API</a>')
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body><nav>{"".join(links)}</nav>{body}</body></html>\n'


def link_to_pages(body: str) -> str:
    """Turn links between Markdown files of the repository into links between the pages made from them."""
    names = {source.name: name for name, source in PAGES.items()}

    def replace(match: re.Match[str]) -> str:
        target, anchor = Path(match["path"]).name, match["anchor"] or ""
        return f'href="{names[target]}.html{anchor}"' if target in names else match[0]

    return re.sub(r'href="(?P<path>[^":#]+\.md)(?P<anchor>#[^"]*)?"', replace, body)


def build_pages(target: Path) -> None:
    """Write one HTML page for every Markdown page."""
    markdown = MarkdownIt("commonmark").enable("table")
    for name, source in PAGES.items():
        text = source.read_text(encoding="utf-8")
        title = next(line.lstrip("# ") for line in text.splitlines() if line.startswith("# "))
        (target / f"{name}.html").write_text(page(title, link_to_pages(markdown.render(text))), encoding="utf-8")
    shutil.copy(ROOT / "LICENSE", target / "LICENSE")


def first_sentence(module: str) -> str:
    """What a module says of itself in the first line of its docstring."""
    return (import_module(module).__doc__ or "").strip().split("\n")[0]


def resolve_lazy_names(module: str) -> None:
    """Put the public names that a module imports on first use where pdoc looks for them."""
    loaded = import_module(module)
    for name in getattr(loaded, "__all__", ()):
        setattr(loaded, name, getattr(loaded, name))


def build_reference(target: Path) -> None:
    """Write a page for every public module, and one that lists them."""
    found = [module.name for module in pkgutil.walk_packages(arcade_torch.__path__, "arcade_torch.")]
    public = ["arcade_torch", *(name for name in found if not any(part.startswith("_") for part in name.split(".")))]
    for name in public:
        resolve_lazy_names(name)
    # Types that a library names in quotes and never exports are shown as they stand.
    warnings.filterwarnings("ignore", message="Error parsing type annotation", category=UserWarning)
    # Where a package has no __all__, pdoc finds its modules by itself as well.
    warnings.filterwarnings("ignore", message="The module specification", category=UserWarning)
    pdoc.render.configure(docformat="google", search=False)
    pdoc.pdoc(*public, output_directory=target / "api")
    rows = "".join(
        f'<tr><td><a href="api/{name.replace(".", "/")}.html"><code>{name}</code></a></td>'
        f"<td>{html.escape(first_sentence(name).replace('`', ''))}</td></tr>"
        for name in public
    )
    (target / "api.html").write_text(page("API", f"<h1>API</h1><table>{rows}</table>"), encoding="utf-8")


def main(target: Path) -> None:
    """Build everything below `target`, replacing what a former build left there."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    build_pages(target)
    build_reference(target)
    print(f"documentation: {target / 'index.html'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "build/docs"))
