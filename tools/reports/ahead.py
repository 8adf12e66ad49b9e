"""What a report looks at, measured before it is written, by several processes at once.

They keep what they measure where the report reads it, in the folders of the runs and of the study.
So the page is the same whoever measured. What a process could not measure the report measures
itself, and says what it always says of it.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from arcade_torch.tools.figures import Part, Progress
from arcade_torch.tools.machine import available_cores
from arcade_torch.tools.measures.beliefs import figure as beliefs
from arcade_torch.tools.measures.checkpoints import measure_run
from arcade_torch.tools.measures.contamination import figure as contamination
from arcade_torch.tools.measures.counterfactual import figure as counterfactual
from arcade_torch.tools.measures.recall_density import figure as recall_density
from arcade_torch.tools.measures.saliency import figure as saliency
from arcade_torch.tools.measures.section import Cells
from arcade_torch.tools.studies.engines import Command
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.processes import Processes
from arcade_torch.tools.studies.shards import part_of

MOST_PROCESSES = 8
"""Each takes most of a gigabyte."""
SHARES = 4
"""Of each process: what one takes longer for, another makes up for."""
FEWEST = 16
"""Measures that are missing: for fewer, processes that have to be started are not worth it."""

Measure = Callable[..., Any]
_OF_ALL_SEEDS: dict[Part, tuple[Measure, Mapping[str, Any]]] = {
    "recall": recall_density.OF_RUN,
    "counterfactual": counterfactual.OF_RUN,
    "contamination": contamination.OF_RUN,
}


class Piece(NamedTuple):
    """One thing to measure."""

    game: str
    measure: Callable[[], object]  # keeps what it measures
    folder: Path  # where it keeps that
    pattern: str  # of the file's name

    @property
    def is_missing(self) -> bool:
        """Whether nothing of it is kept yet."""
        return not any(self.folder.glob(self.pattern))


def pieces_of_runs(cells: Cells, skip: Sequence[Part]) -> list[Piece]:
    """What the parts of a report measure of the runs that it looks into."""
    pieces = list[Piece]()

    def add(game: str, path: Path, measure: Measure, options: Mapping[str, Any]) -> None:
        take = partial(measure_run, path, measure, options)
        pieces.append(Piece(game, take, path / "analysis", f"{measure.__name__}-*.npz"))

    for (_, game, twin), paths in cells.items():
        first = paths[0]
        if "saliency" not in skip:
            take = partial(saliency.measure_strip, first)
            pieces.append(Piece(game, take, first / "analysis", "episode_saliency-*.npz"))
        if "beliefs" not in skip and twin == "partial":
            add(game, first, *beliefs.OF_RUN)
        for part, of_run in _OF_ALL_SEEDS.items():
            if part not in skip:
                for path in paths:
                    add(game, path, *of_run)
    return pieces


def measure_ahead(
    pieces: Sequence[Piece],
    folder: StudyFolder,
    options: Sequence[str],
    workers: int,
    progress: Progress | None,
) -> None:
    """Measure in worker processes, unless so much is kept already that they are not worth it.

    Args:
        pieces: what the report looks at.
        folder: the study.
        options: those of ``arcade-torch report`` that decide what is looked at.
        workers: processes at once; 0 for one a core. One alone is not started.
        progress: called with (what, done, total).
    """
    workers = min(workers or len(available_cores()), MOST_PROCESSES)
    missing = sum(piece.is_missing for piece in pieces)
    if workers == 1 or missing < FEWEST or not folder.is_writable:
        return
    count = workers * SHARES
    # neighbours play the same game: a process goes on with the one that it has loaded
    numbers = sorted(range(count), key=lambda number: (number % SHARES, number))
    log = folder.root / "logs" / "report.log"
    log.unlink(missing_ok=True)
    orders = list[Command]()
    for number in numbers:
        shard = f"{number + 1}/{count}"
        words = ["report", str(folder.root), *options, "--shard", shard]
        orders.append(Command(shard, words, log))
    engine = Processes(workers)
    with closing(engine.run(orders)) as ends:  # type: ignore[type-var]
        for done, _ in enumerate(ends, start=1):
            if progress is not None:
                progress("measures", done, count)
    if not log.stat().st_size:
        log.unlink()


def measure_shard(pieces: Sequence[Piece], shard: str) -> None:
    """Measure one share of the pieces: ``3/10`` is the third tenth."""
    part, parts = part_of(shard)
    by_game = sorted(pieces, key=lambda piece: piece.game)
    begin = len(by_game) * (part - 1) // parts
    end = len(by_game) * part // parts
    for piece in by_game[begin:end]:
        with suppress(ValueError):  # the report says of it what there is to say
            piece.measure()
