"""A card as one HTML page that loads nothing."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from arcade_torch.tools.cards.measure import DELAYS, LAW_SIZES, REACH_WIDTH
from arcade_torch.tools.figures import style
from arcade_torch.tools.measures.bootstrap import Interval
from arcade_torch.tools.reports import page_environment

Card = Mapping[str, Any]


def page(card: Card, pictures: Sequence[str] = ()) -> str:
    """The page of a card; ``pictures`` are those of its study."""
    name = card["name"]
    colour = style.agent_colours([name])[name]
    context: dict[str, Any] = {
        "card": card,
        "palette": [colour],
        "findings": findings(card),
        "tests": _by_test(card["tests"]),
        "pictures": list(pictures),
        "curves": [],
        "law_sizes": LAW_SIZES,
        "reach_width": REACH_WIDTH,
    }
    with style.drawing("light"):
        if "error" not in card["reach"]:
            context["curves"].append(_reach_picture(card, colour))
        if card["recall"]:
            context["curves"].append(_recall_picture(card, colour))
    return str(page_environment().get_template("card.html.j2").render(context))


def findings(card: Card) -> list[str]:
    """What a card says, in sentences that are computed from its numbers."""
    lines = [_laws_sentence(card["laws"])]
    if "error" not in card["cost"]:
        cost = card["cost"]["small"]
        lines.append(
            f"A cell {cost['width']} wide has {cost['parameters']:,} parameters and carries "
            f"{cost['state_bytes']:,} bytes from step to step."
        )
    for rival, ratio in ratios(card).items():
        lines.append(
            f"A step takes {ratio['learning_us']:.2f} times as long as {rival}'s in learning and "
            f"{ratio['acting_us']:.2f} times as long in acting."
        )
    if "error" not in card["context"]:
        lines.append(f"Context length before training: {card['context']['text']}.")
    if card["tests"]:
        lines.append(_tests_sentence(card["tests"]))
    if card["study"]:
        lines.append(_gap_sentence(card["study"]))
    return lines


def ratios(card: Card) -> dict[str, dict[str, float]]:
    """How many times as long as another memory it takes, by that memory; empty if it failed."""
    rows = card["speed"].get("us_a_step", {})
    subject = rows.get(card["name"])
    by_rival = {}
    for rival, times in rows.items():
        if subject and rival != card["name"]:
            by_rival[rival] = {name: subject[name] / times[name] for name in times}
    return by_rival


def reach_text(card: Card, share: str) -> str:
    """The largest lag at which the gradient is a ``tenth`` or a ``hundredth`` of the largest, in
    words.
    """
    steps = card["reach"][share]
    words = "1 step" if steps == 1 else f"{steps} steps"
    is_last = steps >= len(card["reach"]["norms"]) - 1
    return f"{words} or more" if is_last else words


def _gap_sentence(study: Mapping[str, Any]) -> str:
    """What partial observability costs, and how sure it is."""
    value, low, high = (math.nan if end is None else end for end in study["gap"])
    gap = Interval(value, low, high)
    decimals = gap.decimals()
    fact = f"Partial observability costs agents with it {value:.{decimals}f}"
    if not gap.exists:
        return f"{fact}, with a single seed, which says nothing about others."
    ends = f"[{low:.{decimals}f}, {high:.{decimals}f}]"
    if gap.excludes_zero:
        return f"{fact} {ends} of normalised return."
    return (
        f"{fact} of normalised return, but the interval {ends} contains zero, so "
        f"{study['seeds']} seeds do not settle it."
    )


def _laws_sentence(laws: Any) -> str:
    """How many laws are kept, and which are not."""
    if isinstance(laws, Mapping):
        return f"It could not be checked: {laws['error']}."
    broken = [row["law"] for row in laws if not row["passed"]]
    if not broken:
        return f"It keeps all {len(laws)} laws of a memory."
    return f"It breaks {len(broken)} of {len(laws)} laws: {', '.join(broken)}."


def _tests_sentence(cells: Sequence[Mapping[str, Any]]) -> str:
    """How many cells of the heat map are solved."""
    counts = dict[bool, list[bool]]()
    for cell in cells:
        counts.setdefault(cell["new"], []).append(cell["verdict"] == "solved")
    learned = counts.get(False, [])
    new = counts.get(True, [])
    return (
        f"It solves {sum(learned)} of {len(learned)} tests at sizes that it learned, and "
        f"{sum(new)} of {len(new)} at larger ones."
    )


def _by_test(cells: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """The cells of the heat map, by test."""
    tests = dict[str, list[Mapping[str, Any]]]()
    for cell in cells:
        tests.setdefault(cell["test"], []).append(cell)
    return tests


def _reach_picture(card: Card, colour: str) -> dict[str, str]:
    """Gradient reach as a curve."""
    figure, axes = style.panels(1, 1, style.PANEL)
    axis = axes[0, 0]
    axis.plot(card["reach"]["norms"], color=colour)
    axis.set(ylim=(-0.03, 1.05), xlabel="steps back", ylabel="share of the largest")
    axis.set_title("Gradient reach")
    return {
        "picture": style.svg(figure, "gradient reach"),
        "caption": f"a tenth for the last time {reach_text(card, 'tenth')} back, a hundredth "
        f"{reach_text(card, 'hundredth')} back",
    }


def _recall_picture(card: Card, colour: str) -> dict[str, str]:
    """Share of right answers over the delay."""
    figure, axes = style.panels(1, 1, style.PANEL)
    axis = axes[0, 0]
    delays = [row["delay"] for row in card["recall"]]
    shares = [row["accuracy"] for row in card["recall"]]
    axis.plot(delays, shares, color=colour, marker="o")
    axis.axhline(0.25, color=style.NEUTRAL, ls=":", lw=1)
    axis.set(ylim=(-0.03, 1.05), xlabel="steps between symbol and question")
    axis.set(ylabel="share of right answers", xticks=DELAYS)
    axis.set_title("Delayed recall")
    return {
        "picture": style.svg(figure, "delayed recall"),
        "caption": "one symbol of four; dotted: chance",
    }
