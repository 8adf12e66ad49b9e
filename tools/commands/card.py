"""``arcade-torch card``: what there is to say of a memory model, on one page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from arcade_torch.agents.runs.files import check_writable_folder, write_atomic, write_json
from arcade_torch.tools.cards.study import FRAMES, GAMES, SEEDS
from arcade_torch.tools.imports import is_from_user
from arcade_torch.tools.options import Command, at_least, command_line
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.switches import Unless
from arcade_torch.tools.text import counted, say


@dataclass
class Card(Command):
    """Write the card of a memory model: laws, cost, speed beside GRU and LRU, how far back it
    reaches, and what it recalls, as one HTML page and one JSON file.

    It takes seconds for a built-in model of a checkout, whose tests are on file, and about two
    minutes for one of yours; --no-tests leaves them out. --study adds what agents with it learn: 36
    runs of Signpost, MineSweeper and CountRecall, both twins, beside the agent without memory. That
    takes an hour or so; --games, --seeds and --frames make it smaller. Type the same again to go on
    after an interruption.

    Example: arcade-torch card --import yours.py yours --study
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Memory models; by default the only one that --import registers."""
    all: bool = False  # All that are registered.
    # Whether it is trained in the tests of memory, where no results are on file.
    tests: Unless = True
    study: bool = False  # Train agents with it.
    frames: int = FRAMES  # Of each run of the study.
    games: tuple[str, ...] = GAMES  # Of the study, on both twins.
    seeds: int = SEEDS  # Of each agent of the study.
    workers: int = 0  # Runs of the study at once; 0 for one a core.
    html: Unless = True  # Whether the page is written beside the JSON.
    out: Path = Path("cards")  # Folder of the files: NAME.html and NAME.json.

    def run(self) -> int:
        """Measure and write; exit code 1 if a run of a study failed."""
        from arcade_torch.models import make_memory

        at_least(self, frames=1, seeds=1, workers=0)
        names = self.selection()
        check_writable_folder(self.out)
        for name in names:
            make_memory(name, 1, 1)  # refuses a name that is none, before anything is measured
        failed = 0
        for name in names:
            failed += self.write(name)
        return 1 if failed else 0

    def selection(self) -> list[str]:
        """The memory models that are asked for."""
        from arcade_torch.models import memory_names

        if self.all:
            if self.names:
                raise ValueError("give names or --all, not both")
            return memory_names()
        if self.names:
            return list(dict.fromkeys(self.names))
        registered = list(filter(is_from_user, memory_names()))
        if len(registered) != 1:
            given = f"--import registers {', '.join(registered)}" if registered else "none is named"
            raise ValueError(f"name a memory model, or --all: {given}; see arcade-torch list")
        return registered

    def write(self, name: str) -> int:
        """One card; gives the number of runs of its study that failed."""
        from arcade_torch.tools.cards.measure import measure_card

        done = 0
        with Bars(first_line_s=0.0) as bars:

            def tell(part: str) -> None:
                nonlocal done
                bars.update(f"card {name}", done, 0, part)
                done += 1

            card = measure_card(name, self.tests, tell)
        laws = card["laws"]
        if isinstance(laws, dict) or not all(row["passed"] for row in laws):
            from arcade_torch.tools.cards.page import findings

            say(f"{name}: {findings(card)[0]}")
        pictures = list[str]()
        failed = 0
        if self.study:
            failed = self._study(name, card, pictures)
        say(f"card: {write_json(self.out / f'{name}.json', card)}")
        if self.html:
            from arcade_torch.tools.cards.page import page

            say(f"page: {write_atomic(self.out / f'{name}.html', page(card, pictures))}")
        return failed

    def _study(self, name: str, card: dict[str, Any], pictures: list[str]) -> int:
        """Train, and add what it gives to a card; gives the number of runs that failed."""
        from arcade_torch.tools.cards.study import card_study, study_part
        from arcade_torch.tools.commands.study import check_memories_of
        from arcade_torch.tools.figures.style import drawing
        from arcade_torch.tools.studies.runner import make_engine, study

        definition = card_study(name, self.frames, self.games, self.seeds)
        check_memories_of(definition)
        root = self.out / f"{name}-study"
        say(f"{counted(len(definition.runs()), 'run')} of {self.frames:,} frames, in {root}")
        command = command_line(["card", *self.argv])
        result = study(definition, root, make_engine("auto", self.workers), command=command)
        for run, reason in result.errors.items():
            say(f"failed: {run}: {reason}")
        if result.finished == len(result.rows):
            with Bars() as bars, drawing("light"):
                card["study"], drawn = study_part(root, name, definition, bars.update)
            pictures += drawn
        return len(result.errors)

    def resume_hint(self) -> str:
        """What an interruption left, and the command that goes on."""
        line = command_line(["card", *self.argv])
        return f"finished cards and runs are kept; go on with: {line}"
