"""Make the notebooks: run the sources beside this file and write each as ``.ipynb`` with what it
printed and drew.

A source is a Python file in the percent format: its docstring is the first cell, ``# %%`` opens a
code cell, and ``# %% [markdown]`` a text cell written as comments. Edit the sources, not the
notebooks, then:

    python examples/notebooks/build.py                 # all
    python examples/notebooks/build.py saliency        # one
"""

import ast
import base64
import contextlib
import io
import json
import os
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

FOLDER = Path(__file__).resolve().parent
NAMES = (
    "saliency",
    "recall_density",
    "counterfactual",
    "attribution",
    "contamination",
    "own_memory",
    "torchrl_pipeline",
)
DPI = 72
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}


class Cell(NamedTuple):
    """One cell: ``code`` or ``markdown``, and its text."""

    kind: str
    text: str


def read_cells(path: Path) -> list[Cell]:
    """The cells of a source.

    Raises:
        ValueError: it has no docstring.
    """
    source = path.read_text(encoding="utf-8")
    title = ast.get_docstring(ast.parse(source))
    if title is None:
        raise ValueError(f"{path} has no docstring: begin with the title of the notebook")
    cells = [Cell("markdown", title)]
    for part in re.split(r"^# %%", source, flags=re.MULTILINE)[1:]:
        head, _, text = part.partition("\n")
        if head.strip() == "[markdown]":
            cells.append(Cell("markdown", re.sub(r"^# ?", "", text.strip(), flags=re.MULTILINE)))
        else:
            cells.append(Cell("code", text.strip()))
    return cells


def run_cells(
    cells: list[Cell], frames: int | None = None
) -> tuple[dict[str, Any], list[list[dict[str, Any]]]]:
    """Run the code cells one after the other in one namespace.

    Args:
        cells: from `read_cells`.
        frames: another value for the line ``FRAMES = ...``.

    Returns:
        The namespace, and for every cell its outputs: what it printed and the figures it drew, as a
        notebook has them.
    """
    os.environ["MPLBACKEND"] = "agg"
    import matplotlib.pyplot as plt

    namespace: dict[str, Any] = {"__name__": "__main__"}
    outputs: list[list[dict[str, Any]]] = []
    for number, cell in enumerate(cells):
        found: list[dict[str, Any]] = []
        if cell.kind == "code":
            text = (
                cell.text
                if frames is None
                else re.sub(r"(?m)^FRAMES = [\d_]+", f"FRAMES = {frames}", cell.text)
            )
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(text, f"<cell {number}>", "exec"), namespace)
            if printed.getvalue():
                lines = printed.getvalue().splitlines(keepends=True)
                found.append({"output_type": "stream", "name": "stdout", "text": lines})
            found += [_picture(plt.figure(key)) for key in plt.get_fignums()]
            plt.close("all")
        outputs.append(found)
    return namespace, outputs


def _picture(figure: Any) -> dict[str, Any]:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return {"output_type": "display_data", "data": {"image/png": data}, "metadata": {}}


def notebook(cells: list[Cell], outputs: list[list[dict[str, Any]]]) -> str:
    """A notebook, format 4.5, as JSON text."""
    made: list[dict[str, Any]] = []
    for number, (cell, found) in enumerate(zip(cells, outputs, strict=True)):
        entry = {"cell_type": cell.kind, "id": f"cell-{number}", "metadata": {}}
        entry["source"] = cell.text.splitlines(keepends=True)
        if cell.kind == "code":
            entry |= {
                "execution_count": sum(c.kind == "code" for c in cells[: number + 1]),
                "outputs": found,
            }
        made.append(entry)
    metadata = {"kernelspec": KERNEL, "language_info": {"name": "python"}}
    return (
        json.dumps(
            {"cells": made, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}, indent=1
        )
        + "\n"
    )


def main(names: list[str]) -> int:
    """Build some notebooks, all by default."""
    if unknown := sorted(set(names) - set(NAMES)):
        print(f"unknown notebook {unknown[0]!r}: there are {', '.join(NAMES)}", file=sys.stderr)
        return 2
    for name in names or NAMES:
        cells = read_cells(FOLDER / f"{name}.py")
        text = notebook(cells, run_cells(cells)[1])
        (FOLDER / f"{name}.ipynb").write_text(text, encoding="utf-8")
        print(f"{name}.ipynb: {len(cells)} cells, {len(text) / 1000:.0f} kB", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
