"""The part of a report about its subject: one agent beside every other, and what each costs."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from arcade_torch.agents.config import TrainConfig
from arcade_torch.tools.comparable import Runs, listed
from arcade_torch.tools.errors import one_line
from arcade_torch.tools.figures.style import TWIN_NAMES
from arcade_torch.tools.imports import ImportRefusedError, import_again
from arcade_torch.tools.measures.bootstrap import Interval, measured_coverage
from arcade_torch.tools.measures.gap_bias.measure import TWINS
from arcade_torch.tools.measures.gap_bias.pairs import Pair, Task, pair_rows, pairs
from arcade_torch.tools.runs import Run
from arcade_torch.tools.studies.folder import StudyFolder

# below this measured coverage a difference is one of the seeds that were run
TRUSTED_COVERAGE = 0.85
MEANS = {"full": "mean of the MDPs", "partial": "mean of the POMDPs", "": "mean of all"}
"""Rows over all games, by twin."""


def subject_section(
    folder: StudyFolder, runs: Runs, subject: str, metric: str, rival: str
) -> dict[str, Any]:
    """Sentences and tables on one agent against each of the others; the differences are written as
    CSV too. The sentences on Gap and Bias compare it with ``rival`` already.
    """
    scores = runs.scores(metric)
    table = pairs(scores, subject)
    tasks = dict[Task, bool]()  # of any agent: whether the subject has it
    for score in scores:
        if score.observability in TWINS:
            task = (score.game, score.observability)
            tasks[task] = tasks.get(task, False) or score.agent == subject
    folder.keep_table(f"differences_{metric}.csv", pair_rows(table, subject))
    others = list(dict.fromkeys(pair.other for pair in table))
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    has_one_game = len({pair.game for pair in table if pair.game}) == 1
    for pair in table:
        if has_one_game and not pair.game and pair.twin:
            continue  # the mean of one
        name = f"{pair.game} {TWIN_NAMES[pair.twin]}" if pair.game else MEANS[pair.twin]
        row = {"name": name, "is_mean": not pair.game, "mine": pair.subject_return, "pairs": {}}
        rows.setdefault((pair.game, pair.twin), row)["pairs"][pair.other] = pair
    # an agent that lacks a task is compared on the others: the mean in front is over all
    for (game, twin), row in rows.items():
        if not game:
            mine = [pair.subject_return for pair in _first_of_tasks(table, twin)]
            row["mine"] = sum(mine) / len(mine)
    sentences = list[str]()
    for other in others:
        if other != rival:
            sentences.append(subject_sentence(table, subject, other, tasks))
    cost_rows, trouble = costs(runs)
    return {
        "name": subject,
        "others": others,
        "rows": list(rows.values()),
        "sentences": sentences,
        "shorter": _shorter_means(table, subject, others, tasks),
        "costs": cost_rows,
        "trouble": trouble,
    }


def _first_of_tasks(table: Sequence[Pair], twin: str) -> list[Pair]:
    """One pair of every task of a twin, of both where ``twin`` is empty."""
    first: dict[tuple[str, str], Pair] = {}
    for pair in table:
        if pair.game and twin in ("", pair.twin):
            first.setdefault((pair.game, pair.twin), pair)
    return list(first.values())


def _shorter_means(
    table: Sequence[Pair], subject: str, others: Sequence[str], tasks: Mapping[Task, bool]
) -> list[str]:
    """Sentences on the agents whose means are over fewer tasks than others have; ``tasks`` says
    which the subject has.
    """
    sentences = []
    missing = _names(task for task, is_there in tasks.items() if not is_there)
    if missing:
        sentences.append(
            f"{subject} has no finished run on {listed(missing)}: all means are of the other tasks."
        )
    for other in others:
        present = {(pair.game, pair.twin) for pair in table if pair.other == other}
        missing = _names(
            task for task, is_there in tasks.items() if is_there and task not in present
        )
        if missing:
            sentences.append(
                f"{other} has no finished run on {listed(missing)}: its means are of the other "
                "tasks."
            )
    return sentences


def _names(tasks: Iterable[Task]) -> list[str]:
    """Tasks as a page calls them."""
    return [f"{game} {TWIN_NAMES[twin]}" for game, twin in tasks]


def subject_sentence(
    table: Sequence[Pair], subject: str, other: str, of_study: Iterable[Task]
) -> str:
    """What one agent earns against another where something has to be remembered, and where not;
    ``of_study`` are the tasks that any agent has.
    """
    counts = Counter(twin for _, twin in of_study)
    clauses = []
    for twin, place in (("partial", "On the POMDP"), ("full", "on the MDP")):
        of_twin = [pair for pair in table if (pair.twin, pair.other) == (twin, other)]
        if of_twin:
            *tasks, mean = of_twin
            share = f", {len(tasks)} of {counts[twin]} tasks,"
            share = share if len(tasks) < counts[twin] else ""
            clauses.append(f"{place}{share} {_verdict(mean, len(tasks), subject)}")
    sentence = "; ".join(clauses)
    return f"{sentence[0].upper()}{sentence[1:]}." if sentence else ""


def _verdict(pair: Pair, tasks: int, subject: str) -> str:
    """Two returns, and how sure their difference is."""
    fact = (
        f"{subject} reaches a normalised return of {pair.subject_return:.2f} and {pair.other} "
        f"{pair.other_return:.2f}"
    )
    difference = pair.difference
    if not math.isfinite(difference.value):
        return f"{fact}, since the score of a run is no number"
    if not difference.exists:
        return f"{fact}, with a single seed, which says nothing about others"
    if difference.is_zero:
        return f"{fact}, with no difference in any seed"
    ends = signed(difference)
    if not difference.excludes_zero:
        return f"{fact}: {ends} contains zero, so {pair.seeds} seeds do not settle it"
    seeds = (pair.seeds,) * tasks
    trusted = measured_coverage(seeds, seeds) >= TRUSTED_COVERAGE
    place = "ahead" if difference.value > 0 else "behind"
    return f"{fact}: {place} by {ends}" + ("" if trusted else f" over these {pair.seeds} seeds")


def signed(difference: Interval) -> str:
    """A difference and its interval as a sentence writes them."""
    decimals = difference.decimals()
    value, low, high = (f"{number:+.{decimals}f}" for number in difference)
    return f"{value} [{low}, {high}]"


def costs(runs: Runs) -> tuple[list[dict[str, Any]], str]:
    """What every agent costs: parameters, recurrent state, and the speed of its trainings; and why
    something is missing.
    """
    by_agent: dict[str, list[Run]] = {}
    for run in runs.runs:
        by_agent.setdefault(runs.names[run.key], []).append(run)
    rows = list[dict[str, Any]]()
    trouble = ""
    for agent, of_agent in by_agent.items():
        frames = 0.0
        seconds = 0.0
        for run in of_agent:
            final = run.final or {}
            frames += float(final.get("frames") or 0)
            seconds += float(final.get("seconds") or 0)
        row: dict[str, Any] = {"agent": agent, "parameters": None}
        row["fps"] = frames / seconds if seconds else None
        row["seconds"] = seconds / len(of_agent) if seconds else None
        try:
            row |= _sizes(of_agent[0])
        except (ImportRefusedError, ValueError, TypeError) as error:
            trouble = f"Parameters of {agent} are not known: {one_line(error)}."
        rows.append(row)
    return rows, trouble


def _sizes(run: Run) -> dict[str, int]:
    """Parameters of a run's network and of the memory in it, and bytes of the recurrent state of
    one environment.
    """
    from arcade_torch.agents.policy import build_network
    from arcade_torch.models.networks import MemoryBlock

    import_again(run.path)
    config = TrainConfig.from_dict(run.config | {"device": "cpu", "cuda_graphs": False})
    network: Any = build_network(config)
    cells = []
    for module in network.modules():
        if isinstance(module, MemoryBlock):
            cells += list(module.cells)
    state_bytes = 0
    for leaf in network.initial_state(1).values(True, True):
        state_bytes += leaf.nbytes
    return {
        "parameters": _count(network),
        "memory_parameters": sum(map(_count, cells)),
        "state_bytes": state_bytes,
    }


def _count(module: Any) -> int:
    """Numbers that a module learns."""
    return sum(parameter.numel() for parameter in module.parameters())
