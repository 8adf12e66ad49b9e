"""The API reference: a page for every public module, read from the source without importing it."""

import ast
from pathlib import Path

LAYERS = ("arcade_torch", "envs_jax", "models", "agents", "tools")


def modules(root: Path) -> dict[str, list[str]]:
    """Public modules by layer.

    Args:
        root: of the repository.

    Returns:
        Folder to dotted names below ``arcade_torch``, sorted.
    """
    found = {}
    for layer in LAYERS:
        top = root / layer
        sources = top.glob("*.py") if layer == "arcade_torch" else top.rglob("*.py")
        names = (_dotted(path.relative_to(root)) for path in sources)
        found[layer] = sorted(
            name for name in names if not any(part.startswith("_") for part in name.split("."))
        )
    return found


def _dotted(path: Path) -> str:
    parts = path.with_suffix("").parts
    parts = parts if parts[0] == "arcade_torch" else ("arcade_torch", *parts)
    return ".".join(parts).removesuffix(".__init__")


def source_of(root: Path, module: str) -> Path:
    """The file of a module."""
    below = module.split(".")[1:]
    top = root / "arcade_torch" if len(below) < 1 or below[0] not in LAYERS else root
    path = top.joinpath(*below)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def first_line(root: Path, module: str) -> str:
    """What a module says of itself in the first line of its docstring."""
    text = source_of(root, module).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]


def pages(root: Path) -> dict[str, str]:
    """Markdown by place on the site: one page a module, and ``api/index.md`` that lists them."""
    found = modules(root)
    made = {
        f"api/{name}.md": f"# {name.removeprefix('arcade_torch.')}\n\n::: {name}\n"
        for names in found.values()
        for name in names
    }
    lines = [
        "# API",
        "",
        "From the docstrings. What is exported by a package stands on the page of the package.",
        "",
    ]
    for layer, names in found.items():
        lines += [f"## {layer}", "", "| module | |", "|---|---|"]
        lines += [
            f"| [`{name}`]({name}.md) | {first_line(root, name).replace('|', chr(92) + '|')} |"
            for name in names
        ]
        lines.append("")
    return made | {"api/index.md": "\n".join(lines)}


def navigation(root: Path) -> list[object]:
    """The same pages as an entry of the navigation."""
    sections = [
        {layer: [{name.removeprefix("arcade_torch."): f"api/{name}.md"} for name in names]}
        for layer, names in modules(root).items()
    ]
    return ["api/index.md", *sections]
