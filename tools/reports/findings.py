"""The findings of a report as sentences, computed from numbers: they claim a difference only where
its interval excludes zero.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

from arcade_torch.tools.figures.style import TWIN_NAMES
from arcade_torch.tools.measures.bootstrap import Interval, measured_coverage
from arcade_torch.tools.measures.gap_bias.measure import AgentRow, GapBias
from arcade_torch.tools.reports.subject import TRUSTED_COVERAGE, signed


def score_sentences(table: GapBias, subject: str) -> list[str]:
    """All findings, those about the subject first, and then about the agent with the highest return
    on the POMDP.
    """
    rows = []
    for row in table.rows:
        if table.baselines[row.agent] not in (None, row.agent):
            rows.append(row)
    rows.sort(key=lambda row: (row.agent != subject, -row.pomdp.value))
    sentences = []
    for row in rows:
        for name in SENTENCES:
            sentences.append(score_sentence(table, name, row.agent))
    return sentences


def score_sentence(table: GapBias, name: str, agent: str) -> str:
    """One of `SENTENCES` about an agent with memory, how sure it is, and of which tasks if some
    agent lacks one.
    """
    memory_free = table.row(table.baselines[agent] or table.baseline)
    sentence = SENTENCES[name](table, memory_free, table.row(agent))
    if table.dropped:
        tasks = len(table.tasks)
        total = tasks + len(table.dropped)
        sentence = f"{sentence[:-1]}, over the {tasks} of {total} games that all agents have."
    return sentence


def gap_sentence(table: GapBias, memory_free: AgentRow, agent: AgentRow) -> str:
    """What partial observability costs an agent with memory, and one without."""
    # as they are printed, and without a minus before zero
    without, with_memory = (round(row.gap.value, 2) + 0.0 for row in (memory_free, agent))
    fact = (
        f"Partial observability costs the memory-free agent {without:.2f} of normalised return and "
        f"{agent.agent} {with_memory:.2f}"
    )
    difference = table.difference("gap", memory_free.agent, agent.agent)
    size = f"{abs(difference.value):.{difference.decimals()}f}"
    # a gap below zero that rises to zero is no wider
    is_signed = min(without, with_memory) < 0
    seeds = min(memory_free.seeds, agent.seeds)
    if not difference.exists:
        return (
            f"{fact}: a difference of {difference.value:+.2f} with a single seed, which says "
            "nothing about others."
        )
    if difference.is_zero:
        return f"{fact}: the gap is the same in every seed."
    if not difference.excludes_zero:
        smaller, larger = ("lower", "higher") if is_signed else ("smaller", "larger")
        side = smaller if difference.value > 0 else larger
        return (
            f"{fact}: with memory the gap is {size} {side}, but the interval "
            f"{_ends(difference)} contains zero, so {seeds} seeds do not settle it."
        )
    memory = f"{_few_seeds(memory_free, agent)} memory".strip()
    narrows, widens = ("lowers", "raises") if is_signed else ("narrows", "widens")
    effect = narrows if difference.value > 0 else widens
    ends = sorted((abs(difference.low), abs(difference.high)))
    near, far = (f"{end:.{difference.decimals()}f}" for end in ends)
    return f"{fact}: {memory} {effect} the observability gap by {size} [{near}, {far}]."


def pomdp_sentence(table: GapBias, memory_free: AgentRow, agent: AgentRow) -> str:
    """What an agent with memory reaches where observations are partial, and one without."""
    fact = (
        f"On the POMDP {agent.agent} reaches a normalised return of {agent.pomdp.value:.2f}, the "
        f"memory-free agent {memory_free.pomdp.value:.2f}"
    )
    difference = table.difference("pomdp", agent.agent, memory_free.agent)
    if not difference.exists:
        return f"{fact}."
    if difference.is_zero:
        return f"{fact}, with no difference in any seed."
    if difference.excludes_zero:
        few = _few_seeds(memory_free, agent)
        return f"{fact}, a difference of {signed(difference)}{few}."
    return f"{fact}; the interval of the difference {_ends(difference)} contains zero."


def bias_sentence(table: GapBias, memory_free: AgentRow, agent: AgentRow) -> str:
    """What memory costs where it is not needed."""
    place = f"On the MDP, where memory is not needed, {agent.agent}"
    if agent.bias.is_zero:
        return f"{place} earns what the memory-free agent does, in every seed."
    effect = "costs" if agent.bias.value < 0 else "adds"
    size = f"{abs(agent.bias.value):.{agent.bias.decimals()}f}"
    fact = f"{place} {effect} {size} against the memory-free agent"
    if not agent.bias.exists:
        return f"{fact}."
    if agent.bias.excludes_zero:
        few = _few_seeds(memory_free, agent)
        return f"{fact}{few} (bias {_ends(agent.bias)})."
    return f"{fact}, which is within the noise (bias {_ends(agent.bias)} contains zero)."


SENTENCES = {"gap": gap_sentence, "pomdp": pomdp_sentence, "bias": bias_sentence}
"""The findings of a report, in their order: number of the table -> who writes its sentence."""


def _few_seeds(memory_free: AgentRow, agent: AgentRow) -> str:
    """Of which seeds a finding is, where they are too few to say more; empty where not."""
    if min(memory_free.coverage, agent.coverage) >= TRUSTED_COVERAGE:
        return ""
    return f" over these {min(memory_free.seeds, agent.seeds)} seeds"


def _ends(interval: Interval) -> str:
    """The ends of an interval as a report writes them."""
    return signed(interval).partition(" ")[2]


def coverage_sentence(table: GapBias) -> str:
    """How much the intervals are worth with so few seeds."""
    return _coverage_sentence(table.coverage, table.confidence, "gap")


def coverage_of_means(counts: Iterable[int], confidence: float = 0.95) -> str:
    """The same where there is no table: what intervals of means are worth, of so many seeds."""
    fewest = min((count for count in counts if count > 1), default=None)
    coverage = dict[int, float]()
    if fewest is not None:
        coverage[fewest] = measured_coverage((fewest,), (), confidence)
    return _coverage_sentence(coverage, confidence, "mean")


def _coverage_sentence(coverage: Mapping[int, float], confidence: float, number: str) -> str:
    """How often an interval holds the true number, by the number of seeds."""
    if not coverage:
        return (
            "With a single seed there are no intervals: repeat with more seeds before believing a "
            "difference."
        )
    seeds, share = min(coverage.items())
    narrow = ", so it is narrower than it claims" if share < confidence else ""
    return (
        f"Intervals are nominal {100 * confidence:g} % percentile bootstrap over seeds. "
        f"With {seeds} seeds such an interval held the true {number} in {100 * share:.0f} % of "
        f"simulated studies{narrow}."
    )


def way(value: float, levels: Mapping[str, float]) -> float | None:
    """The share of the way from the random policy to the oracle; None where that is not known."""
    low = levels.get("random")
    high = levels.get("state")
    if low is None or high is None or high == low or not math.isfinite(value):
        return None
    return (value - low) / (high - low)


def learning_sentence(
    game: str, twin: str, finals: Mapping[str, Sequence[float]], levels: Mapping[str, float]
) -> str:
    """Where the agents of one task ended between the random policy and the oracle; empty where that
    is not known.
    """
    shares = list[str]()
    below = list[str]()
    for agent, returns in finals.items():
        share = way(sum(returns) / len(returns), levels)
        if share is None:
            return ""
        shares.append(f"{agent} {100 * share:.0f} %")
        if min(returns) <= levels["random"]:
            below.append(agent)
    if not shares:
        return ""
    task = f"{game} {TWIN_NAMES[twin]}"
    fact = f"{task}, share of the way from random to oracle: {', '.join(shares)}"
    if below:
        return f"{fact}; a seed of {' and of '.join(below)} did not get above random."
    return f"{fact}, every seed above random."
