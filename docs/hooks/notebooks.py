"""Notebooks and scripts as pages: text, code, and what running it printed and drew."""

import ast
import base64
import json
from pathlib import Path
from typing import Any


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook with its outputs.

    Args:
        path: the .ipynb file.

    Returns:
        Markdown, and the pictures it shows, by file name.
    """
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            parts += _shown(output, path.stem, pictures)
    parts.append(f"Source: [{path.stem}.py]({path.stem}.py), notebook: [{path.name}]({path.name}).")
    return "\n\n".join(parts) + "\n", pictures


def _shown(output: dict[str, Any], stem: str, pictures: dict[str, bytes]) -> list[str]:
    data = output.get("data", {})
    if "image/png" in data:
        name = f"{stem}-{len(pictures)}.png"
        pictures[name] = base64.b64decode("".join(data["image/png"]))
        return [f"![What the cell above draws]({name})"]
    text = "".join(output.get("text") or data.get("text/plain") or ())
    return [f"```text\n{text.rstrip()}\n```"] if text.strip() else []


def script_page(path: Path) -> str:
    """A Python file: its first sentence as title, then the whole of it."""
    code = path.read_text(encoding="utf-8")
    first = (ast.get_docstring(ast.parse(code)) or path.name).partition("\n")[0]
    return f"# {path.name}\n\n{first}\n\n```python\n{code.rstrip()}\n```\n"
