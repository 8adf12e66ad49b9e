"""``arcade-torch compare``: one memory model beside others, in a few minutes."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arcade_torch.agents.checked import require
from arcade_torch.tools.commands.study import Resumable, check_memories_of
from arcade_torch.tools.figures import Part
from arcade_torch.tools.imports import is_from_user
from arcade_torch.tools.machine import available_cores
from arcade_torch.tools.options import at_least, at_most
from arcade_torch.tools.studies.budget import FEWEST_FRAMES, Budget, Size, measure_speed
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import Study, compare_study
from arcade_torch.tools.studies.runner import make_engine, planned
from arcade_torch.tools.switches import Unless
from arcade_torch.tools.text import counted, say, warn

GAMES = ("SignpostEasy", "MineSweeperEasy", "CountRecallEasy")
"""A probe that nobody plays without memory, and two of the ten games."""
A_WEEK = 7 * 24 * 60


@dataclass
class Compare(Resumable):
    """Train a memory model, mostly one of yours, beside others, and write a report about it.

    A small study of Signpost, MineSweeper and CountRecall, both twins, several seeds, as large as
    the minutes allow: the speed of this machine is measured first, and the last games are left out
    where there is no time for them. Type the same again to go on after an interruption.

    Example: arcade-torch compare --import yours.py --memory yours --against lru none --minutes 10
    """

    word = "compare"
    memory: str = ""  # The memory model; by default the only one that --import registers.
    against: tuple[str, ...] = ("lru", "none")  # Others; none is the agent without memory.
    minutes: float = 10.0  # How long all may take, the report included.
    games: tuple[str, ...] = ()  # Games to play in the place of those three, all of them.
    seeds: int | None = None  # Runs of each agent, game and twin; as many as fit by default.
    frames: int | None = None  # Environment steps of each run; as many as fit by default.
    out: Path | None = None  # Folder of the study; runs/compare-MEMORY by default.
    workers: int = 0  # Runs at once; 0 for one a core.
    skip: tuple[Part, ...] = ("contamination",)  # Parts that the report leaves out, see report.
    # Whether the laws that a memory has to keep are checked before models of yours are trained.
    check_memory: Unless = True

    def run(self) -> int:
        """Train, and write the report; exit code 1 if a run failed."""
        at_least(self, minutes=1, workers=0)
        at_most(self, minutes=A_WEEK)
        for name in ("seeds", "frames"):
            if getattr(self, name) is not None:
                at_least(self, **{name: 1})
        engine = make_engine("auto", self.workers)
        memory = self.memory or _only_memory()
        out = self.out or Path("runs") / f"compare-{memory}"
        definition = self._definition(memory, out)
        say(_described(definition))
        return self.carry_out(definition, out, engine, skip=self.skip)

    def _definition(self, memory: str, out: Path) -> Study:
        """The study: that of the folder if there is one, or else one of a size that fits."""

        def of_size(games: tuple[str, ...], seeds: Any, frames: int) -> Study:
            return compare_study(
                memory,
                self.against,
                self.games or games,
                self.frames or frames,
                self.seeds or seeds,
            )

        draft = of_size(GAMES, 1, 100_000)
        planned(draft)
        if self.check_memory:
            check_memories_of(draft)
        if (out / "study.json").exists():
            before = StudyFolder(out).load()
            say(f"going on with the study in {out}")
            return of_size(before.games, before.seeds, before.total_frames or FEWEST_FRAMES)
        if self.seeds and self.frames:
            return draft
        warn("measuring the speed of this machine")
        workers = self.workers or len(available_cores())
        budget = Budget(len(draft.memories), workers, measure_speed(draft))
        size = budget.fit(
            draft.games, self.minutes, self.seeds, self.frames, all_games=bool(self.games)
        )
        _say_size(budget, size, draft.games, self.minutes)
        return of_size(*size)


def _only_memory() -> str:
    """The memory model that ``--import`` has registered, if it is one."""
    from arcade_torch.models import memory_names

    names = list(filter(is_from_user, memory_names()))
    given = ", ".join(names) or "none"
    require(len(names) == 1, "--memory", given, "named unless --import registers just one")
    return names[0]


def _say_size(budget: Budget, size: Size, games: tuple[str, ...], minutes: float) -> None:
    """Say how long it takes, and what there is no time for."""
    wanted = budget.minutes(len(size.games), size.seeds, size.frames)
    fps = budget.speed.frames_per_s
    say(f"about {wanted:.0f} minutes, at {fps:,.0f} frames/s of each of {budget.workers} workers")
    if wanted > 1.1 * minutes:
        say(f"no study of {minutes:g} minutes is large enough to show anything: this is the least")
    left_out = games[len(size.games) :]
    if left_out:
        enough = math.ceil(budget.minutes(len(games), 2, 60_000))
        say(f"left out for want of time: {', '.join(left_out)}; --minutes {enough} has them")


def _described(study: Study) -> str:
    """What is trained, in one line."""
    subject, *others = study.memories
    runs = len(study.runs())
    return (
        f"{subject} against {', '.join(others)} on {', '.join(study.games)}, as MDP and POMDP, "
        f"{counted(len(study.seeds), 'seed')} of {study.total_frames or 0:,} frames: {runs} runs"
    )
