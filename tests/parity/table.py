"""The table of ``make parity``: results/parity.md."""

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.tools.machine import versions
from tests.parity.reference import PACKAGE
from tests.parity.translations import TASKS
from tests.parity.walk import OTHER_ENVS, RANDOM_ENVS, STEPS, Tally

Row = tuple[Tally, Tally]
COLUMNS = (
    "task",
    "random: steps",
    "episodes",
    "rewards differ",
    "endings differ",
    "rare: steps",
    "episodes",
    "at the limit",
    "rewards differ",
    "endings differ",
    "states or flags differ",
)

HEAD = f"""# Parity with {PACKAGE} {{published}}

Both games from the same states, with the same actions, step for step; ours with `rules="reference"`. Written by
`make parity`.

A mismatch of rewards is a difference above one millionth. An ending is the end of the episode, by the game or by the
time limit. *Random*: uniformly random actions from first states of the published package, {RANDOM_ENVS} envs of {STEPS}
steps. *Rare*: {OTHER_ENVS} more envs that hold on to an action for long or follow the state oracle; half of their
episodes begin near an end of the game, half near the time limit. *States*: the whole state after a step, compared in
our form and, in mid-episode, in the published form. What a published step draws (the block of Skittles, the bag of
Tetris) is handed to ours. The flags `terminated` and `truncated` were compared as well, after the intended differences
that `tests/parity/translations` names (A3, C1, K3, S9, T5).

| {" | ".join(COLUMNS)} |
|---{"|--:" * (len(COLUMNS) - 1)}|
"""


def line(task: str, row: Row) -> str:
    """One task."""
    plain, rare = row
    states = plain.state + plain.back + plain.flags + rare.state + rare.back + rare.flags
    cells: list[int] = [plain.steps, plain.episodes, plain.reward, plain.ending]
    cells += [rare.steps, rare.episodes, rare.limits, rare.reward, rare.ending, states]
    return f"| {task} | " + " | ".join(f"{cell:,}" for cell in cells) + " |"


def write(path: Path, rows: Mapping[str, Row]) -> str:
    """Write the table and return it; a run that left out tasks writes nothing and says so."""
    if absent := [task for task in TASKS if task not in rows]:
        return f"{path} is left as it is: {len(absent)} of {len(TASKS)} tasks were not walked"
    lines = [line(task, rows[task]) for task in TASKS]
    total = tuple(sum_of([row[kind] for row in rows.values()]) for kind in (0, 1))
    made = ", ".join(
        f"{name} {value}" for name, value in {**versions(), PACKAGE: version(PACKAGE)}.items()
    )
    text = HEAD.format(published=version(PACKAGE)) + "\n".join(
        [*lines, line("all", (total[0], total[1]))]
    )
    text += f"\n\nMade with {made}.\n"
    write_atomic(path, text)
    return text


def sum_of(tallies: list[Tally]) -> Tally:
    """All counts added up."""
    return Tally(
        **{
            name: sum(getattr(tally, name) for tally in tallies)
            for name in Tally.__dataclass_fields__
        }
    )
