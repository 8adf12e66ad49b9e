"""Sentences computed from numbers: they claim a difference only where its interval excludes zero."""

from collections.abc import Mapping, Sequence

from arcade_torch.tools.analysis.bootstrap import Interval
from arcade_torch.tools.analysis.gap_bias import AgentRow, GapBias

TRUSTED_COVERAGE = 0.85  # below this measured coverage a difference is one of the seeds that were run
_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def number_words(count: int) -> str:
    """Small numbers as words."""
    return _NUMBERS[count] if 0 <= count < len(_NUMBERS) else str(count)


def ends(interval: Interval) -> str:
    """The interval alone, empty if there is none."""
    return "" if interval.low != interval.low else f" [{interval.low:+.2f}, {interval.high:+.2f}]"


def score_sentences(table: GapBias) -> list[str]:
    """Three sentences about every agent with memory, the strongest on the POMDP first."""
    found = []
    for row in sorted(table.rows[1:], key=lambda row: -row.pomdp.value):
        found += [gap_sentence(table, row.agent), pomdp_sentence(table, row.agent), bias_sentence(row)]
    return found


def gap_sentence(table: GapBias, agent: str) -> str:
    """What memory does to the observability gap, and how sure that is."""
    base, row = table.row(table.baseline), table.row(agent)
    narrowed = table.gap_difference(table.baseline, agent)
    facts = (
        f"Partial observability costs the memory-free agent {base.gap.value:.2f} of normalised return "
        f"and {agent} {row.gap.value:.2f}"
    )
    if narrowed.low != narrowed.low:
        return f"{facts}: a difference of {narrowed.value:+.2f} with a single seed, which says nothing about others."
    seeds = number_words(min(base.seeds, row.seeds))
    if narrowed.excludes_zero:
        verb = "narrows" if narrowed.value > 0 else "widens"
        weak = min(base.coverage, row.coverage) < TRUSTED_COVERAGE
        where = f"over these {seeds} seeds memory" if weak else "memory"
        low, high = sorted((abs(narrowed.low), abs(narrowed.high)))
        by = f"{abs(narrowed.value):.2f} [{low:.2f}, {high:.2f}]"
        return f"{facts}: {where} {verb} the observability gap by {by}."
    direction = "smaller" if narrowed.value > 0 else "larger"
    return (
        f"{facts}: with memory the gap is {abs(narrowed.value):.2f} {direction}, but the interval{ends(narrowed)} "
        f"contains zero, so {seeds} seeds do not settle it."
    )


def pomdp_sentence(table: GapBias, agent: str) -> str:
    """Whether memory raises the return where observations are partial."""
    base, row = table.row(table.baseline), table.row(agent)
    more = table.pomdp_difference(agent, table.baseline)
    reached = f"a normalised return of {row.pomdp.value:.2f}, the memory-free agent {base.pomdp.value:.2f}"
    facts = f"On the POMDP {agent} reaches {reached}"
    if more.low != more.low:
        return facts + "."
    if more.excludes_zero:
        return f"{facts}, a difference of {more.value:+.2f}{ends(more)}."
    return f"{facts}; the interval of the difference{ends(more)} contains zero."


def bias_sentence(row: AgentRow) -> str:
    """What memory costs or gives where it is not needed."""
    effect = "costs" if row.bias.value < 0 else "adds"
    facts = f"On the MDP, where memory is not needed, {row.agent} {effect} {abs(row.bias.value):.2f}"
    if row.bias.low != row.bias.low:
        return facts + " against the memory-free agent."
    if row.bias.excludes_zero:
        return f"{facts} against the memory-free agent (bias{ends(row.bias)})."
    return f"{facts} against the memory-free agent, which is within the noise (bias{ends(row.bias)} contains zero)."


def coverage_sentence(table: GapBias) -> str:
    """How much the intervals are worth with so few seeds; empty where there are none."""
    known = {row.seeds: row.coverage for row in table.rows if row.coverage == row.coverage}
    if not known:
        return "With a single seed there are no intervals: repeat with more seeds before believing a difference."
    seeds, share = min(known.items())
    return (
        f"Intervals are nominal {100 * table.confidence:g} % percentile bootstrap over seeds. "
        f"With {number_words(seeds)} seeds such an interval held the true gap in {100 * share:.0f} % of simulated "
        "studies, so it is narrower than it claims."
    )


def way(value: float, levels: Mapping[str, float]) -> float | None:
    """The share of the way from the random policy to the oracle; None where that is not known."""
    low, high = levels.get("random"), levels.get("state")
    return None if low is None or high is None or high == low else (value - low) / (high - low)


def learning_sentence(game: str, twin: str, finals: Mapping[str, Sequence[float]], levels: Mapping[str, float]) -> str:
    """Where the agents of one task ended between the random policy and the oracle."""
    ways = {agent: way(sum(values) / len(values), levels) for agent, values in finals.items()}
    if not ways or None in ways.values():
        return ""
    said = ", ".join(f"{agent} {100 * share:.0f} %" for agent, share in ways.items() if share is not None)
    below = [agent for agent, values in finals.items() if min(values) <= levels["random"]]
    kind = "MDP" if twin == "full" else "POMDP"
    tail = f"; a seed of {' and of '.join(below)} did not get above random" if below else ", every seed above random"
    return f"{game} {kind}, share of the way from random to oracle: {said}{tail}."
