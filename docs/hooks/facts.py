"""Facts that have their owner elsewhere, put into a page where it says ``<!-- insert: KIND NAME
-->``.

In the repository the mark is invisible, and the sentence beside it links to the owner.
"""

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
MARK = re.compile(r"^<!-- insert: (?P<kind>\w+) (?P<name>[^>\n]*?) -->$", re.MULTILINE)
CARDS = "results/cards"
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


def card(name: str) -> str:
    """What the card of a memory model says, from its JSON file."""
    from arcade_torch.tools.cards.page import reach_text

    found = _card(name)
    context = found["context"]
    rows = [
        ("context length, before training", context["text"]),
        ("gradient reach, a tenth of the largest", reach_text(found, "tenth")),
        ("gradient reach, a hundredth of the largest", reach_text(found, "hundredth")),
    ]
    for rival, ratio in _ratios(found).items():
        rows.append((f"time of learning, `{rival}` is 1", f"{ratio['learning_us']:.2f}"))
        rows.append((f"time of acting, `{rival}` is 1", f"{ratio['acting_us']:.2f}"))
    for words, new in (("that it learned", False), ("beyond those", True)):
        cells = [row["verdict"] == "solved" for row in found["tests"] if row["new"] == new]
        if cells:
            rows.append((f"tests solved, at sizes {words}", f"{sum(cells)} of {len(cells)}"))
    lines = ["| card | |", "|---|--:|", *(f"| {title} | {value} |" for title, value in rows)]
    return "\n".join(lines)


def cards(_: str) -> str:
    """The cards of all built-in memory models, a line each."""
    from arcade_torch.tools.cards.page import reach_text

    heads = ["memory", "laws kept", "parameters", "state, bytes", "context length"]
    heads += ["a tenth of the gradient", "learning, GRU is 1", "acting, GRU is 1"]
    heads += ["solved, learned sizes", "solved, larger sizes"]
    lines = [f"| {' | '.join(heads)} |", "|---" + "|--:" * (len(heads) - 1) + "|"]
    for path in sorted((ROOT / CARDS).glob("*.json")):
        found = _card(path.stem)
        kept = [law["passed"] for law in found["laws"]]
        size = found["cost"]["small"]
        cells = [
            f"`{path.stem}`",
            f"{sum(kept)} of {len(kept)}",
            f"{size['parameters']:,}",
            f"{size['state_bytes']:,}",
            found["context"]["text"],
            reach_text(found, "tenth"),
        ]
        ratio = _ratios(found).get("gru", {"learning_us": 1.0, "acting_us": 1.0})
        cells += [f"{ratio['learning_us']:.2f}", f"{ratio['acting_us']:.2f}"]
        for new in (False, True):
            solved = [row["verdict"] == "solved" for row in found["tests"] if row["new"] == new]
            cells.append(f"{sum(solved)} of {len(solved)}" if solved else "")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _card(name: str) -> dict[str, Any]:
    path = ROOT / CARDS / f"{name}.json"
    if not path.is_file():
        raise ValueError(
            f"{CARDS} has no card of {name!r}: arcade-torch card {name} --no-html --out {CARDS}"
        )
    values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return values


def _ratios(found: dict[str, Any]) -> dict[str, dict[str, float]]:
    from arcade_torch.tools.cards.page import ratios

    return ratios(found)


def agents(_: str) -> str:
    """The agents that the package ships, a line each."""
    heads = ["agent", "learner", "frames", "mean return", "without rounding", "bytes"]
    lines = [f"| {' | '.join(heads)} |", "|---|---" + "|--:" * 4 + "|"]
    for path in sorted((ROOT / "agents/shipped").glob("*/results.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        size = (path.parent / "model.safetensors").stat().st_size
        cells = [
            f"`{path.parent.name}`",
            found["algorithm"].upper(),
            f"{found['frames']:,}",
            f"{found['mean_reward']:.3f}",
            f"{found['mean_reward_float32']:.3f}",
            f"{size:,}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


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
    "agents": agents,
    "card": card,
    "cards": cards,
    "picture": picture,
}
"""What can be inserted, and how it is found."""
