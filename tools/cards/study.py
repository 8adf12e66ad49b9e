"""What agents with a memory learn, for its card: a small study, as `compare` trains it."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from arcade_torch.tools.comparable import Runs, find_runs
from arcade_torch.tools.figures import Progress
from arcade_torch.tools.figures.style import TWIN_NAMES
from arcade_torch.tools.measures.bootstrap import Interval, pooled
from arcade_torch.tools.measures.counterfactual.figure import counterfactual_section
from arcade_torch.tools.measures.gap_bias.measure import gap_and_bias
from arcade_torch.tools.names import find_agent
from arcade_torch.tools.studies.grid import Study, compare_study

GAMES = ("SignpostEasy", "MineSweeperEasy", "CountRecallEasy")
SEEDS = 3
FRAMES = 100_000
"""Of each run, by default."""
REPORTED = ("memory", "observation", "memory_differing", "observation_differing")
"""Numbers of counterfactual recall on a card."""


def card_study(
    memory: str, frames: int = FRAMES, games: Sequence[str] = GAMES, seeds: int = SEEDS
) -> Study:
    """The study of a card: a memory beside the agent without one, and LRU as the rival of that."""
    rivals = ("lru",) if memory == Study.baseline else (Study.baseline,)
    return compare_study(memory, rivals, tuple(games), frames, seeds)


def study_part(
    root: Path, memory: str, study: Study, progress: Progress | None = None
) -> tuple[dict[str, Any], list[str]]:
    """What a finished study says of a memory.

    Args:
        root: folder of the study.
        memory: what the card is about.
        study: as `card_study` gave it.
        progress: called with (what, done, total) while decisions are measured.

    Returns:
        Values for the JSON of the card; pictures of counterfactual recall, SVG elements.
    """
    runs = find_runs([root / "runs"])
    subject = find_agent(runs.names, memory)
    table = gap_and_bias(runs.scores("eval_final"), baseline=study.baseline)
    row = table.row(subject)
    returns = []
    for (agent, game, twin), of_cell in runs.groups().items():
        interval = pooled([run.value("eval_final") for run in of_cell])
        value = Interval(float(interval.mean), float(interval.low), float(interval.high))
        task = {"agent": agent, "game": game, "twin": TWIN_NAMES[twin], "seeds": len(of_cell)}
        returns.append(task | {"return": _ends(value)})
    section = counterfactual_section(_cells(runs, subject), [subject], progress, gradients=False)
    exchanges = []
    for entry in section["rows"]:
        measured = {name: _ends(entry[name]) for name in REPORTED}
        exchanges.append({"game": entry["game"], "twin": entry["twin"]} | measured)
    part = {
        "subject": subject,
        "frames": study.total_frames,
        "seeds": len(study.seeds),
        "gap": _ends(row.gap),
        "bias": _ends(row.bias),
        "mdp": _ends(row.mdp),
        "pomdp": _ends(row.pomdp),
        "returns": returns,
        "counterfactual": exchanges,
        "notes": list(section["notes"]),
    }
    return part, section["pictures"]


def _cells(runs: Runs, subject: str) -> dict[tuple[str, str, str], list[Path]]:
    """The run folders of the memory, by game and twin."""
    cells = {}
    for key, of_cell in runs.groups().items():
        if key[0] == subject:
            cells[key] = [run.path for run in of_cell]
    return cells


def _ends(interval: Interval) -> list[float | None]:
    """A number and the ends of its interval; None where there is none."""
    return [None if math.isnan(end) else float(f"{end:.4g}") for end in interval]
