"""Links between files of the repository, as links between the pages that the site makes of them."""

import re
from posixpath import dirname, normpath, relpath

PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "results/README.md": "results/measurements.md",
    "results/differences.md": "results/differences.md",
    "results/parity.md": "results/parity.md",
    "results/small.md": "results/small.md",
    "results/gpu-rehearsal.md": "results/gpu-rehearsal.md",
    "results/gpu-aot.md": "results/gpu-aot.md",
    "results/probe.md": "results/probe.md",
    "results/memory.md": "results/memory.md",
    "results/memory_tests.md": "results/memory_tests.md",
    "results/recipe.md": "results/recipe.md",
    "examples/notebooks": "notebooks.md",
}
"""Repository path to place on the site, for what does not lie in docs/."""

NOTEBOOKS = "examples/notebooks/"

_FENCE = re.compile(r"^( *)```.*?^\1```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(?<=\]\()(?P<path>[^)\s#:]+)(?P<anchor>#[^)\s]*)?(?=\))")


def place(path: str) -> str:
    """Where a file of the repository lies on the site.

    Args:
        path: relative to the repository.

    Returns:
        Path on the site: a page for Markdown, Python and notebooks, the file itself for anything
        else.
    """
    path = path.rstrip("/")
    if path in PAGES:
        return PAGES[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path.startswith(NOTEBOOKS) and path != NOTEBOOKS + "build.py":
        return "notebooks/" + path.removeprefix(NOTEBOOKS).rpartition(".")[0] + ".md"
    return path.removesuffix(".py") + ".md" if path.endswith(".py") else f"files/{path}"


def targets(text: str, source: str) -> list[str]:
    """Files of the repository that a page links to, in order.

    Args:
        text: Markdown.
        source: its own path, relative to the repository.
    """
    found = (match["path"] for part in _prose(text) for match in _LINK.finditer(part))
    return [normpath(f"{dirname(source)}/{path}" if dirname(source) else path) for path in found]


def rewrite(text: str, source: str, at: str) -> str:
    """Links as they have to stand on the site.

    Args:
        text: Markdown with links as they work in the repository.
        source: its path in the repository.
        at: the page of the site on which it will stand.
    """

    def replace(match: re.Match[str]) -> str:
        path = normpath(f"{dirname(source)}/{match['path']}" if dirname(source) else match["path"])
        return relpath(place(path), dirname(at) or ".") + (match["anchor"] or "")

    end, parts = 0, []
    for fence in _FENCE.finditer(text):
        parts += [_LINK.sub(replace, text[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, _LINK.sub(replace, text[end:])])


def _prose(text: str) -> list[str]:
    return _FENCE.sub("\0", text).split("\0")
