"""What each difference is worth in return: ``python -m tests.parity.effects`` writes it into
results/differences.md.

Needs no published package: our ``rules="reference"`` stands for it, which ``make parity`` shows to
be the same law.
"""

import argparse
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from arcade_torch.agents.runs.files import write_atomic
from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.oracles import RandomPlayer, make_oracle, play
from arcade_torch.envs_jax.registry import DIFFICULTIES, GAMES
from arcade_torch.tools.machine import versions
from tests.parity.faults import FAULTS, Fault, take_all

PAGE = Path(__file__).resolve().parents[2] / "results/differences.md"
BEGIN, END = "<!-- effects: begin -->\n", "<!-- effects: end -->\n"
RANDOM_EPISODES, ORACLE_EPISODES = 4096, 512
Returns = npt.NDArray[np.float64]

TEXT = """
Undiscounted returns of two players: uniformly random actions ({random:,} episodes a number) and the scripted player
that sees the state ({oracle:,}), with 95 % intervals. Random numbers are shared by both rules where they can be, so a
difference is often known better than its two sides. `rules="reference"` stands for the published law, which
`make parity` shows to be the same ([results/parity.md](parity.md)). `python -m tests.parity.effects` writes
this section; made with {versions}.

**All differences of a task together.**

| task | random: reference | default | difference | state oracle: reference | default | difference |
|---|--:|--:|--:|--:|--:|--:|
{tasks}

**Each alone**: the return with this one corrected, minus that of the reference, on Easy / Medium / Hard. The flags of
A3, C1, K3, S9 and T5, the number of actions (A5, C11) and everything that is only drawn change no return.

| id | random | state oracle |
|---|---|---|
{faults}
"""


def returns(game: Any, planner: Any) -> dict[str, Returns]:
    """Returns of both players, one entry an episode; env i of two games with one law sees the same
    random numbers.
    """
    players = {
        "random": (RandomPlayer(0), RANDOM_EPISODES),
        "oracle": (make_oracle(planner), ORACLE_EPISODES),
    }
    return {
        name: play(game, player, episodes, block=episodes).returns.astype(np.float64)
        for name, (player, episodes) in players.items()
    }


def interval(values: Returns, *, signed: bool = False) -> str:
    """Mean and half width of its 95 % interval; a plain 0 where all values are 0.

    Example:
        >>> interval(np.array([0.0, 1.0] * 50)), interval(np.zeros(9), signed=True)
        ('0.500 ± 0.098', '0')
    """
    if signed and not values.any():
        return "0"
    half = 1.96 * values.std() / np.sqrt(len(values))
    if signed:
        return f"{values.mean():+.3g} ± {half:.1g}"
    return f"{values.mean():.3f} ± {half:.3f}"


def task_line(task: str, before: dict[str, Returns], after: dict[str, Returns]) -> str:
    """One task under both rules."""
    cells = [task]
    for player in ("random", "oracle"):
        change = interval(after[player] - before[player], signed=True)
        cells += [interval(before[player]), interval(after[player]), change]
    return "| " + " | ".join(cells) + " |"


def fault_line(fault: Fault, changes: list[dict[str, Returns]]) -> str:
    """One difference on all levels."""
    ids = f"{fault.ids} ({fault.game})"
    cells = [
        " / ".join(interval(change[player], signed=True) for change in changes)
        for player in ("random", "oracle")
    ]
    return f"| {ids} | {' | '.join(cells)} |"


def measure(games: Iterable[str]) -> tuple[list[str], list[str]]:
    """Lines of both tables for some games."""
    tasks, faults = [], []
    for game in games:
        own = [fault for fault in FAULTS if fault.game == game]
        changes: dict[str, list[dict[str, Returns]]] = {fault.ids: [] for fault in own}
        for level in DIFFICULTIES:
            task, start = game + level, time.perf_counter()
            reference = make(task, rules="reference")
            before = returns(reference, reference)
            everything, planner = Fault("all", game, take_all, "default").corrected(task)
            tasks.append(task_line(task, before, returns(everything, planner)))
            for fault in own:
                after = returns(*fault.corrected(task))
                changes[fault.ids].append(
                    {player: after[player] - before[player] for player in before}
                )
            print(f"{tasks[-1]}  {time.perf_counter() - start:.0f} s", flush=True)
        faults += [fault_line(fault, changes[fault.ids]) for fault in own]
        print(*faults[len(faults) - len(own) :], sep="\n", flush=True)
    return tasks, faults


def main() -> None:
    """Measure, and write the section if all games were measured."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.parity.effects", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--games", nargs="+", choices=GAMES, default=GAMES, help="fewer games are printed alone"
    )
    games = parser.parse_args().games
    tasks, faults = measure(games)
    if set(games) != set(GAMES):
        return
    made = ", ".join(
        f"{name} {value}" for name, value in versions().items() if not name.startswith("t")
    )
    tables = {"tasks": "\n".join(tasks), "faults": "\n".join(faults)}
    text = TEXT.format(random=RANDOM_EPISODES, oracle=ORACLE_EPISODES, versions=made, **tables)
    page = PAGE.read_text(encoding="utf-8")
    head, found, rest = page.partition(BEGIN)
    if not found or END not in rest:
        raise SystemExit(
            f"{PAGE} has no place for the effects: a line {BEGIN!r} and below it a line {END!r}"
        )
    write_atomic(PAGE, head + BEGIN + text + END + rest.partition(END)[2])


if __name__ == "__main__":
    main()
