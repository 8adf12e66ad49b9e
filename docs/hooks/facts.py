"""Facts that have their owner elsewhere, put into a page where it says ``<!-- insert: KIND NAME
-->``.

In the repository the mark is invisible, and the sentence beside it links to the owner.
"""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MARK = re.compile(r"^<!-- insert: (?P<kind>\w+) (?P<name>[^>\n]*?) -->$", re.MULTILINE)
LEVELS = ("Easy", "Medium", "Hard")


def insert(text: str) -> str:
    """Replace every mark of a page.

    Raises:
        ValueError: a mark asks for something that is not there.
    """
    return MARK.sub(lambda match: fact(match["kind"], match["name"]), text)


def fact(kind: str, name: str) -> str:
    """One fact in Markdown.

    Args:
        kind: a key of `KINDS`.
        name: of a game without its level, of a section, or of a memory model.

    Raises:
        ValueError: there is no such kind, or its owner says nothing of that name.
    """
    if kind not in KINDS:
        raise ValueError(f"<!-- insert: {kind} {name} -->: known are {', '.join(KINDS)}")
    return KINDS[kind](name)


def read(path: str) -> str:
    """A file of the repository."""
    return (ROOT / path).read_text(encoding="utf-8")


def section(path: str, title: str) -> str:
    """What stands below one heading of a page, without the heading.

    Raises:
        ValueError: the page has no such heading.
    """
    _, found, after = read(path).partition(f"\n## {title}\n")
    if not found:
        raise ValueError(f"{path} has no section {title!r}")
    return after.partition("\n## ")[0].strip()


def table_rows(text: str, wanted: re.Pattern[str], what: str) -> str:
    """The rows of the table in a text whose first cell fits, under its heading, in the order of the
    levels.
    """
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = [line for line in lines[2:] if wanted.match(line)]
    if not rows:
        raise ValueError(f"no row for {what}")
    rows.sort(
        key=lambda row: next((place for place, level in enumerate(LEVELS) if level in row), -1)
    )
    return "\n".join([*lines[:2], *rows])


def limits(game: str) -> str:
    """Step limits and range of returns of a game."""
    text = read("docs/environments.md").partition("| id |")
    return table_rows("".join(text[1:]).partition("\n\n")[0], _row(game), f"the limits of {game}")


def probe(game: str) -> str:
    """Step limits and range of returns of a game that the table of the benchmark leaves out."""
    from arcade_torch.envs_jax import make, probe_ids

    games = [
        make(f"{game}{level}")
        for level in LEVELS
        if any(id.startswith(f"{game}{level}-v") for id in probe_ids())
    ]
    if not games:
        raise ValueError(f"no probe is called {game!r}")
    rows = [
        f"| `{made.id}` | {made.max_steps} | {made.return_range[0]:.4g} | "
        f"{made.return_range[1]:.4g} |"
        for made in games
    ]
    return "\n".join(
        ["| id | limit (steps) | lowest return | highest return |", "|---|---|---|---|", *rows]
    )


def earned(game: str) -> str:
    """What random play and scripted players earn in a game."""
    return table_rows(
        section("docs/environments.md", "What players earn"), _row(game), f"the returns of {game}"
    )


def differences(title: str) -> str:
    """What differs from the published game."""
    return section("results/differences.md", title)


def recall(name: str) -> str:
    """What a memory model reached in delayed recall."""
    wanted = re.compile(rf"\| `{re.escape(name)}[`,]")
    return table_rows(
        section("docs/memories.md", "Delayed recall"), wanted, f"the recall of {name}"
    )


def cost(name: str) -> str:
    """Parameters, state and arithmetic of one cell, counted while the site is built."""
    from arcade_torch.models import make_memory
    from arcade_torch.models.presets import PRESETS
    from arcade_torch.tools.bench.memory import memory_cost

    lines = [
        "| one cell | parameters | state, numbers | state, bytes | multiply-adds a step |",
        "|---|--:|--:|--:|--:|",
    ]
    for preset, size in (("paper's network", 512), ("small network", PRESETS["small"].hidden_size)):
        found = memory_cost(make_memory(name, size, size), size)
        numbers = (found.parameters, found.state_numbers, found.state_bytes, found.products)
        lines.append(
            f"| {preset}, {size} wide | " + " | ".join(f"{number:,}" for number in numbers) + " |"
        )
    return "\n".join(lines)


def laws(name: str) -> str:
    """How far a memory model is from each law, measured in float64 while the site is built."""
    import torch

    from arcade_torch.models import check_memory, make_memory

    torch.manual_seed(0)
    found = check_memory(make_memory(name, 8, 16))
    return "\n".join(
        [
            "| law | largest deviation |",
            "|---|--:|",
            *(f"| {law} | {far:.1g} |" for law, far in found.items()),
        ]
    )


def picture(words: str) -> str:
    """A picture that a notebook drew: its name, the number of the picture, and what it shows."""
    stem, number, says = words.split(maxsplit=2)
    return f"![{says}](../notebooks/{stem}-{number}.png)"


def _row(game: str) -> re.Pattern[str]:
    return re.compile(rf"\| `{re.escape(game)}({'|'.join(LEVELS)})-v\d+`")


KINDS = {
    "limits": limits,
    "probe": probe,
    "earned": earned,
    "differences": differences,
    "recall": recall,
    "cost": cost,
    "laws": laws,
    "picture": picture,
}
"""What can be inserted, and how it is found."""
